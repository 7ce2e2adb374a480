// SPDX-License-Identifier: Apache-2.0
// Shapes of a scene: tubes, points and arrows as instanced meshes, and thin lines.

import {
  BufferGeometry, BoxGeometry, Color, ConeGeometry, CylinderGeometry, DoubleSide,
  Float32BufferAttribute, InstancedMesh, LineBasicMaterial, LineDashedMaterial, LineSegments,
  Matrix4, Mesh, MeshBasicMaterial, MeshLambertMaterial, Quaternion, SphereGeometry, Vector3,
} from "three";

const UP = new Vector3(0, 1, 0);

/** Return an instanced mesh with these colors, whose instances have no place yet. */
function makeInstances(geometry, colors, isShaded) {
  const Material = isShaded ? MeshLambertMaterial : MeshBasicMaterial;
  const mesh = new InstancedMesh(geometry, new Material(), colors.length);
  colors.forEach((color, i) => mesh.setColorAt(i, new Color(color)));
  mesh.frustumCulled = false;
  return mesh;
}

/** Return the matrix that takes a shape along y from -0.5 to 0.5 onto the line from a to b. */
function placeAlong(a, b, radius) {
  const along = new Vector3(b[0] - a[0], b[1] - a[1], b[2] - a[2]);
  const length = along.length();
  if (!(length > 0)) return new Matrix4().makeScale(0, 0, 0);
  const turn = new Quaternion().setFromUnitVectors(UP, along.divideScalar(length));
  const middle = new Vector3((a[0] + b[0]) / 2, (a[1] + b[1]) / 2, (a[2] + b[2]) / 2);
  return new Matrix4().compose(middle, turn, new Vector3(radius, length, radius));
}

/** Tubes of one radius each between pairs of points. */
export class Tubes {
  constructor(colors, radii) {
    this.mesh = makeInstances(new CylinderGeometry(1, 1, 1, 12), colors, true);
    this.radii = radii;
  }

  /** Place tube i from a to b. */
  place(i, a, b) {
    this.mesh.setMatrixAt(i, placeAlong(a, b, this.radii[i]));
    this.mesh.instanceMatrix.needsUpdate = true;
  }
}

/** Spheres or boxes at points. */
export class Points {
  constructor(colors, radii, isBox = false, isShaded = true) {
    const geometry = isBox ? new BoxGeometry(2, 2, 2) : new SphereGeometry(1, 16, 12);
    this.mesh = makeInstances(geometry, colors, isShaded);
    this.radii = radii;
  }

  /** Place the shape i at a point. */
  place(i, point) {
    const size = this.radii[i];
    this.mesh.setMatrixAt(i, new Matrix4().makeScale(size, size, size).setPosition(...point));
    this.mesh.instanceMatrix.needsUpdate = true;
  }
}

/** Arrows of one color: shafts with a head at their end. */
export class Arrows {
  constructor(count, color, radius) {
    const colors = new Array(count).fill(color);
    this.shafts = makeInstances(new CylinderGeometry(1, 1, 1, 6), colors, false);
    this.heads = makeInstances(new ConeGeometry(1, 1, 10), colors, false);
    this.radius = radius;
  }

  /** Place arrow i from a to b; a short arrow has a small head. */
  place(i, a, b) {
    const length = Math.hypot(b[0] - a[0], b[1] - a[1], b[2] - a[2]);
    const head = Math.min(7 * this.radius, length / 2);
    const share = length > 0 ? head / length : 0;
    const neck = b.map((value, k) => value - share * (value - a[k]));
    this.shafts.setMatrixAt(i, placeAlong(a, neck, this.radius));
    this.heads.setMatrixAt(i, placeAlong(neck, b, 0.36 * head));
  }

  /** Return the meshes. */
  get meshes() {
    return [this.shafts, this.heads];
  }
}

/** Return thin lines between pairs of points (flat array), dashed where a length is given. */
export function makeLines(points, color, dash = 0) {
  const geometry = new BufferGeometry().setAttribute("position", new Float32BufferAttribute(points, 3));
  const material = dash
    ? new LineDashedMaterial({ color, dashSize: dash, gapSize: 0.7 * dash })
    : new LineBasicMaterial({ color });
  const lines = new LineSegments(geometry, material);
  lines.frustumCulled = false;
  if (dash) lines.computeLineDistances();
  return lines;
}

/** Move lines to other points. */
export function moveLines(lines, points) {
  lines.geometry.attributes.position.set(points);
  lines.geometry.attributes.position.needsUpdate = true;
  if (lines.material.isLineDashedMaterial) lines.computeLineDistances();
}

/** Return a translucent surface of triangles from the first of n points to the others. */
export function makeFan(count, color) {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new Float32BufferAttribute(new Float32Array(3 * count), 3));
  const corners = [];
  for (let i = 1; i + 1 < count; i++) corners.push(0, i, i + 1);
  geometry.setIndex(corners);
  const material = new MeshBasicMaterial({
    color, transparent: true, opacity: 0.18, side: DoubleSide, depthWrite: false,
  });
  const mesh = new Mesh(geometry, material);
  mesh.frustumCulled = false;
  return mesh;
}
