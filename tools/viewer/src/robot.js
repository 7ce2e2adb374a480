// SPDX-License-Identifier: Apache-2.0
// A robot: its parts as shapes, which move when another pose is shown.

import { Group } from "three";
import { pointOf } from "./data.js";
import { Points, Tubes, makeFan, makeLines, moveLines } from "./shapes.js";

/** Roles of tubes and of points, with their radii as multiples of the thickness. */
const THICKNESS = { limb: 1, rod: 0.7, axis: 0.35, platform: 0.8, arm: 0.4, frame: 0.4 };
const RADIUS = { joint: 1.35, slide: 1.5, "rod drive": 1.35, end: 1.1, tool: 1.7 };
const DRIVEN = 1.9;

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

/** The shapes of a robot in a group; `show` moves them. */
export class Robot {
  constructor(scene, thickness) {
    this.group = new Group();
    let first = 0;
    const parts = scene.parts.map((part) => {
      const placed = { ...part, first };
      first += part.count;
      return placed;
    });
    this.count = first;
    this.tubes = parts.filter((part) => part.role in THICKNESS);
    this.dots = parts.filter((part) => part.role in RADIUS);
    this.lines = ["base", "guide"].map((role) => parts.filter((part) => part.role === role));
    this.platform = parts.find((part) => part.role === "platform" && part.count > 3);
    this.makeShapes(scene, thickness);
    this.show(scene.home, 0);
  }

  makeShapes(scene, thickness) {
    const colors = [];
    const radii = [];
    for (const part of this.tubes) {
      for (let i = 0; i + 1 < part.count; i++) {
        colors.push(part.color);
        radii.push(thickness * THICKNESS[part.role]);
      }
    }
    this.pipes = new Tubes(colors, radii);
    this.group.add(this.pipes.mesh);
    this.balls = [false, true].map((isBox) => {
      const chosen = this.dots.filter((part) => (part.shape === "box") === isBox);
      const shape = new Points(
        chosen.map((part) => (part.filled ? part.color : "#e8e8e8")),
        chosen.map((part) => thickness * (part.filled && part.role !== "tool" ? DRIVEN : RADIUS[part.role])),
        isBox,
      );
      if (chosen.length) this.group.add(shape.mesh);
      return { chosen, shape };
    });
    const still = pairUp(this.lines[0], scene.home);
    const dashed = pairUp(this.lines[1], scene.home);
    this.drawn = [makeLines(still, "#999999", 3 * thickness), makeLines(dashed, "#666666", 5 * thickness)];
    this.group.add(...this.drawn);
    if (this.platform) {
      this.fan = makeFan(this.platform.count - 1, this.platform.color);
      this.group.add(this.fan);
    }
  }

  /** Show the robot of points that begin at point `start` of a flat array. */
  show(points, start) {
    const own = points.subarray(3 * start, 3 * (start + this.count));
    let i = 0;
    for (const part of this.tubes) {
      for (let j = 0; j + 1 < part.count; j++) {
        this.pipes.place(i++, pointOf(own, part.first + j), pointOf(own, part.first + j + 1));
      }
    }
    for (const { chosen, shape } of this.balls) {
      chosen.forEach((part, k) => shape.place(k, pointOf(own, part.first)));
    }
    this.drawn.forEach((lines, k) => moveLines(lines, pairUp(this.lines[k], own)));
    if (this.platform) {
      const { first, count } = this.platform;
      const corners = this.fan.geometry.attributes.position;
      corners.set(own.subarray(3 * first, 3 * (first + count - 1)));
      corners.needsUpdate = true;
    }
  }
}
