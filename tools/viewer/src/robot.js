// SPDX-License-Identifier: Apache-2.0
// A robot: its parts as shapes, which move when another pose is shown.

import { Group } from "three";
import { pointOf } from "./data.js";
import { Points, Slab, Tubes, makeLines, moveLines } from "./shapes.js";

/** Roles of tubes and of points, with their radii as multiples of the thickness. */
const THICKNESS = {
  limb: 1, rod: 0.7, sleeve: 1.25, piston: 0.65, cable: 0.22, axis: 0.3, base: 0.35, platform: 0.7, arm: 0.35, frame: 0.35,
};
const RADIUS = { joint: 1.35, slide: 1.6, "rod drive": 1.35, end: 1.15, tool: 1.5 };
const DRIVEN = 1.7;
const STEEL = "#dfe3e8"; // of joints that are not driven, and of the piston of a driven rod
const SLABS = {
  platform: { color: "#9fb0c3", opacity: 0.6, hasShadow: true },
  base: { color: "#c4ccd6", opacity: 0.4, hasShadow: false },
};

/** Return the tubes of a part by color, radius and the shares of the part at which they begin and end. */
function listTubes(part) {
  if (part.role !== "rod" || !part.filled) return [{ part, color: part.color, radius: THICKNESS[part.role], from: 0, to: 1 }];
  return [
    { part, color: part.color, radius: THICKNESS.sleeve, from: 0, to: 0.5 },
    { part, color: STEEL, radius: THICKNESS.piston, from: 0.5, to: 1 },
  ];
}

/** Return the pairs of consecutive points of parts as a flat array. */
function pairUp(parts, points) {
  const pairs = [];
  for (const part of parts) {
    for (let i = 0; i + 1 < part.count; i++) {
      pairs.push(...pointOf(points, part.first + i), ...pointOf(points, part.first + i + 1));
    }
  }
  return pairs;
}

const GHOST = 0.5; // opacity of a second robot

/** The shapes of a robot in a group; `show` moves them. A second robot is translucent, in one color. */
export class Robot {
  constructor(scene, thickness, color = null) {
    this.group = new Group();
    this.color = color;
    let first = 0;
    const parts = scene.parts.map((part) => {
      const placed = { ...part, first };
      first += part.count;
      return placed;
    });
    this.count = first;
    this.tubes = parts.filter((part) => part.role in THICKNESS).flatMap(listTubes);
    this.dots = parts.filter((part) => part.role in RADIUS);
    this.guides = parts.filter((part) => part.role === "guide");
    this.plates = parts.filter((part) => part.role in SLABS && part.count > 3 && !(color && part.role === "base"));
    this.makeShapes(scene, thickness);
    this.show(scene.home, 0);
  }

  makeShapes(scene, thickness) {
    const colors = [];
    const radii = [];
    for (const { part, color, radius } of this.tubes) {
      for (let i = 0; i + 1 < part.count; i++) {
        colors.push(this.color ?? color);
        radii.push(thickness * radius);
      }
    }
    const opacity = this.color ? GHOST : 1;
    this.pipes = new Tubes(colors, radii, opacity);
    this.group.add(this.pipes.mesh);
    this.balls = [false, true].map((isBox) => {
      const chosen = this.dots.filter((part) => (part.shape === "box") === isBox);
      const shape = new Points(
        chosen.map((part) => this.color ?? (part.filled ? part.color : STEEL)),
        chosen.map((part) => thickness * (part.filled && part.role !== "tool" ? DRIVEN : RADIUS[part.role])),
        isBox,
        true,
        opacity,
      );
      if (chosen.length) this.group.add(shape.mesh);
      return { chosen, shape };
    });
    this.lines = makeLines(pairUp(this.guides, scene.home), "#666666", 5 * thickness);
    this.slabs = this.plates.map((part) => 
      new Slab(part.count - 1, 1.2 * thickness, { ...SLABS[part.role], ...(this.color && { color: this.color, opacity: GHOST, isBent: true, hasShadow: false }) }));
    this.group.add(this.lines, ...this.slabs.map((slab) => slab.mesh));
  }

  /** Show the robot of points that begin at point `start` of a flat array. */
  show(points, start) {
    const own = points.subarray(3 * start, 3 * (start + this.count));
    let i = 0;
    for (const { part, from, to } of this.tubes) {
      for (let j = 0; j + 1 < part.count; j++) {
        const [a, b] = [0, 1].map((k) => pointOf(own, part.first + j + k));
        const [start, end] = [from, to].map((share) => a.map((value, k) => value + share * (b[k] - value)));
        this.pipes.place(i++, start, end);
      }
    }
    for (const { chosen, shape } of this.balls) {
      chosen.forEach((part, k) => shape.place(k, pointOf(own, part.first)));
    }
    moveLines(this.lines, pairUp(this.guides, own));
    this.plates.forEach(({ first, count }, k) => this.slabs[k].place(own.subarray(3 * first, 3 * (first + count - 1))));
  }
}
