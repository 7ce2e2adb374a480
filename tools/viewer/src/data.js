// SPDX-License-Identifier: Apache-2.0
// The scene that a page contains as JSON; arrays of numbers are base64 of 32-bit floats.
// src/loopcal/report/scene/scene.py writes it and states what each entry means.

/** Return the numbers of an entry. */
function decode(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return new Float32Array(bytes.buffer);
}

/** Return the scene of a script element of type application/json. */
export function readScene(element) {
  const scene = JSON.parse(element.textContent);
  scene.home = decode(scene.home);
  for (const key of ["robots", "tools", "errors"]) scene.poses[key] = decode(scene.poses[key]);
  if (scene.map) scene.map.points = decode(scene.map.points);
  for (const motion of scene.motions) motion.shift = decode(motion.shift);
  return scene;
}

/** Return point i of a flat array as [x, y, z]. */
export function pointOf(values, i) {
  return [values[3 * i], values[3 * i + 1], values[3 * i + 2]];
}

/** Return a + factor * b of two points. */
export function addScaled(a, b, factor) {
  return a.map((value, k) => value + factor * b[k]);
}

/** Return all points that a scene draws, and their lowest and highest corner. */
export function findBounds(scene) {
  const points = [];
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  const include = (point) => {
    points.push(point);
    for (let k = 0; k < 3; k++) {
      low[k] = Math.min(low[k], point[k]);
      high[k] = Math.max(high[k], point[k]);
    }
  };
  for (let i = 0; i < scene.home.length / 3; i++) include(pointOf(scene.home, i));
  const { tools, errors, magnification } = scene.poses;
  for (let i = 0; i < tools.length / 3; i++) {
    include(pointOf(tools, i));
    include(addScaled(pointOf(tools, i), pointOf(errors, i), magnification));
  }
  for (const { shift } of scene.motions.slice(0, 1)) {
    for (let i = 0; i < shift.length / 3; i++) include(addScaled(pointOf(scene.home, i), pointOf(shift, i), 1));
  }
  for (let i = 0; scene.map && i < scene.map.colors.length; i++) include(pointOf(scene.map.points, i));
  return { points, low, high };
}

/** Return 1, 2 or 5 times a power of ten, at most the length. */
export function roundDown(length) {
  const power = 10 ** Math.floor(Math.log10(length));
  return power * [5, 2, 1].find((step) => step * power <= length * (1 + 1e-9));
}
