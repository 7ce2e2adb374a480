// SPDX-License-Identifier: Apache-2.0
// Bundle src/viewer.js with the parts of three.js that it uses, and state the licenses of both.

import { copyFileSync, readFileSync } from "node:fs";
import { build } from "esbuild";

const FOLDER = "../../src/loopcal/report/scene";
const license = "node_modules/three/LICENSE";
const version = JSON.parse(readFileSync("node_modules/three/package.json", "utf8")).version;

await build({
  entryPoints: ["src/viewer.js"],
  outfile: `${FOLDER}/viewer.min.js`,
  bundle: true,
  minify: true,
  format: "iife",
  target: "es2022",
  charset: "ascii",
  legalComments: "none",
  banner: {
    js: [
      "/*! The 3-D view of loopcal, SPDX-License-Identifier: Apache-2.0; source: tools/viewer.",
      `Contains three.js ${version}:`,
      readFileSync(license, "utf8").replace(/[^\x00-\x7f]/g, "(c)").trim(),
      "*/",
    ].join("\n"),
  },
});
copyFileSync(license, `${FOLDER}/three.LICENSE.txt`);
