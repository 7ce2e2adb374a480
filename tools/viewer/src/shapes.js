// SPDX-License-Identifier: Apache-2.0
// Shapes of a scene: tubes, points and arrows as instanced meshes, and thin lines.

import {
  BufferGeometry, BoxGeometry, Color, ConeGeometry, CylinderGeometry, DoubleSide,
  Float32BufferAttribute, InstancedMesh, LineBasicMaterial, LineDashedMaterial, LineSegments,
  Matrix4, Mesh, MeshBasicMaterial, MeshPhongMaterial, Quaternion, SphereGeometry, Vector3,
} from "three";

const UP = new Vector3(0, 1, 0);

/** Return an instanced mesh with these colors, whose instances have no place yet. */
function makeInstances(geometry, colors, isShaded, opacity = 1) {
  const look = { opacity, transparent: opacity < 1 };
  const material = isShaded ? new MeshPhongMaterial({ ...look, specular: "#333333", shininess: 40 }) : new MeshBasicMaterial(look);
  const mesh = new InstancedMesh(geometry, material, colors.length);
  mesh.castShadow = isShaded && opacity === 1;
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
  constructor(colors, radii, opacity = 1) {
    this.mesh = makeInstances(new CylinderGeometry(1, 1, 1, 24), colors, true, opacity);
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
  constructor(colors, radii, isBox = false, isShaded = true, opacity = 1) {
    const geometry = isBox ? new BoxGeometry(2, 2, 2) : new SphereGeometry(1, 24, 16);
    this.mesh = makeInstances(geometry, colors, isShaded, opacity);
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
    this.meshes.forEach((mesh) => (mesh.instanceMatrix.needsUpdate = true));
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

/** A translucent plate with n corners; unless it may be bent, it vanishes where they are in no plane. */
export class Slab {
  constructor(count, thickness, { color, opacity, hasShadow, isBent = false }) {
    this.thickness = thickness;
    this.isBent = isBent;
    const corners = [];
    for (let i = 1; i + 1 < count; i++) corners.push(0, i, i + 1, count, count + i + 1, count + i);
    for (let i = 0; i < count; i++) {
      const next = (i + 1) % count;
      corners.push(i, count + i, next, next, count + i, count + next);
    }
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new Float32BufferAttribute(new Float32Array(6 * count), 3));
    geometry.setIndex(corners);
    const material = new MeshPhongMaterial({
      color, opacity, specular: "#222222", transparent: true, side: DoubleSide, depthWrite: false, flatShading: true,
    });
    this.mesh = new Mesh(geometry, material);
    this.mesh.frustumCulled = false;
    this.mesh.castShadow = hasShadow;
  }

  /** Place the plate between corners (flat array). */
  place(corners) {
    const count = corners.length / 3;
    const points = Array.from({ length: count }, (_, i) => new Vector3().fromArray(corners, 3 * i));
    const normal = new Vector3(); // the sum of all triangles, after Newell
    points.forEach((point, i) => normal.add(point.clone().cross(points[(i + 1) % count])));
    const size = Math.sqrt(normal.length());
    normal.normalize();
    const heights = points.map((point) => point.clone().sub(points[0]).dot(normal));
    this.mesh.visible = this.isBent || Math.max(...heights) - Math.min(...heights) < 0.02 * size;
    const places = this.mesh.geometry.attributes.position;
    points.forEach((point, i) => {
      for (const side of [0, 1]) {
        const { x, y, z } = point.clone().addScaledVector(normal, (side - 0.5) * this.thickness);
        places.setXYZ(i + side * count, x, y, z);
      }
    });
    places.needsUpdate = true;
  }
}

/** Return a translucent solid of triangles (flat list of indices) between points with these colors. */
export function makeSolid(points, triangles, colors) {
  const geometry = new BufferGeometry().setAttribute("position", new Float32BufferAttribute(points, 3));
  geometry.setAttribute("color", new Float32BufferAttribute(colors.flatMap((color) => new Color(color).toArray()), 3));
  geometry.setIndex(triangles);
  const material = new MeshBasicMaterial({
    vertexColors: true, transparent: true, opacity: 0.7, side: DoubleSide, depthWrite: false,
  });
  return new Mesh(geometry, material);
}
