// SPDX-License-Identifier: Apache-2.0
// The canvas of a scene: camera, light, mouse, touch and keyboard. It draws only after a change.

import {
  Color, DirectionalLight, HemisphereLight, Mesh, PerspectiveCamera, PlaneGeometry, Scene,
  ShadowMaterial, Spherical, Vector3, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

const FIELD = 30; // of view, in degrees
const FILLED = 0.86; // of the canvas, so that names have room
const TURN = Math.PI / 36;
const NEAREST = 10; // pixels within which a click selects a point

/** Directions from which a scene is seen, and which of its sides is up on the screen. */
const VIEWS = {
  perspective: [0.25, -0.9, 0.38],
  above: [0, -1e-4, 1],
  front: [0, -1, 0],
  right: [1, 0, 0],
};

export class Stage {
  /** Throws an error where the browser has no WebGL. */
  constructor(canvas, bounds, start) {
    const context = canvas.getContext("webgl2", { antialias: true, alpha: false });
    if (!context) throw new Error("no WebGL");
    this.canvas = canvas;
    this.points = bounds.points;
    this.low = bounds.floor;
    this.middle = new Vector3().fromArray(bounds.low).add(new Vector3().fromArray(bounds.high)).divideScalar(2);
    this.radius = Math.max(this.middle.distanceTo(new Vector3().fromArray(bounds.high)), 1e-9);
    this.renderer = new WebGLRenderer({ canvas, context });
    this.renderer.setPixelRatio(Math.min(2, window.devicePixelRatio || 1));
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.autoUpdate = false; // shadows stay while the camera moves
    this.scene = new Scene();
    this.scene.background = new Color("#ffffff");
    this.camera = new PerspectiveCamera(FIELD, 1, this.radius / 50, this.radius * 50);
    this.camera.up.set(0, 0, 1);
    const lamp = new DirectionalLight("#ffffff", 0.9); // goes with the camera
    lamp.position.set(-0.4, 0.6, 1);
    this.camera.add(lamp);
    this.scene.add(this.camera, new HemisphereLight("#ffffff", "#b4bac2", 2.2), ...this.makeSun());
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.minDistance = this.radius / 10;
    this.controls.maxDistance = this.radius * 15;
    this.listeners = [];
    this.start = start;
    this.isAsked = false;
    this.controls.addEventListener("change", () => this.draw(false));
    canvas.addEventListener("keydown", (event) => this.answerKey(event));
  }

  /** Return a light from above with its target, and the floor that shows its shadows. */
  makeSun() {
    const sun = new DirectionalLight("#ffffff", 1.7);
    const { radius, middle } = this;
    sun.position.set(-0.35, -0.15, 1.6).multiplyScalar(2 * radius).add(middle);
    sun.target.position.copy(middle);
    sun.castShadow = true;
    sun.shadow.mapSize.set(2048, 2048);
    sun.shadow.radius = 3;
    sun.shadow.normalBias = 0.004 * radius;
    const { camera } = sun.shadow;
    [camera.left, camera.right, camera.bottom, camera.top] = [-1.5, 1.5, -1.5, 1.5].map((k) => k * radius);
    [camera.near, camera.far] = [0.1 * radius, 8 * radius];
    const floor = new Mesh(new PlaneGeometry(8 * radius, 8 * radius), new ShadowMaterial({ opacity: 0.2 }));
    floor.position.set(middle.x, middle.y, this.low - 0.001 * radius);
    floor.receiveShadow = true;
    return [sun, sun.target, floor];
  }

  /** Call a function after each drawing. */
  onDraw(listener) {
    this.listeners.push(listener);
  }

  /** Fit the drawing to the width of its place. */
  resize(width, height) {
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.renderer.setSize(width, height);
    this.draw();
  }

  /** Draw once before the next picture of the screen; shadows, too, where shapes have moved. */
  draw(hasMoved = true) {
    this.renderer.shadowMap.needsUpdate ||= hasMoved;
    if (this.isAsked) return;
    this.isAsked = true;
    requestAnimationFrame(() => {
      this.isAsked = false;
      this.renderer.render(this.scene, this.camera);
      for (const listener of this.listeners) listener();
    });
  }

  /** See everything from a direction of VIEWS. */
  look(name) {
    const direction = new Vector3().fromArray(VIEWS[name]).normalize();
    this.controls.target.copy(this.middle);
    this.camera.position.copy(direction).multiplyScalar(4 * this.radius).add(this.middle);
    this.controls.update();
    for (let i = 0; i < 4; i++) this.fit();
    this.draw();
  }

  /** Move the camera sideways and along its direction so that all points fill the canvas. */
  fit() {
    this.camera.updateMatrixWorld();
    const low = [Infinity, Infinity];
    const high = [-Infinity, -Infinity];
    for (const point of this.points) {
      const seen = new Vector3().fromArray(point).project(this.camera);
      [seen.x, seen.y].forEach((value, k) => {
        low[k] = Math.min(low[k], value);
        high[k] = Math.max(high[k], value);
      });
    }
    const offset = this.camera.position.clone().sub(this.controls.target);
    const half = offset.length() * Math.tan((FIELD * Math.PI) / 360);
    const right = new Vector3().setFromMatrixColumn(this.camera.matrixWorld, 0);
    const up = new Vector3().setFromMatrixColumn(this.camera.matrixWorld, 1);
    const shift = right.multiplyScalar(((low[0] + high[0]) / 2) * half * this.camera.aspect);
    this.controls.target.add(shift.add(up.multiplyScalar(((low[1] + high[1]) / 2) * half)));
    const filled = Math.max(high[0] - low[0], high[1] - low[1]) / 2;
    this.camera.position.copy(offset).multiplyScalar(filled / FILLED).add(this.controls.target);
    this.controls.update();
  }

  /** Turn the camera about the middle [rad]. */
  turn(around, upwards) {
    const offset = this.camera.position.clone().sub(this.controls.target);
    const place = new Spherical().setFromCartesianCoords(offset.x, offset.z, -offset.y);
    place.theta += around;
    place.phi = Math.min(Math.max(place.phi - upwards, 1e-4), Math.PI - 1e-4);
    const { x, y, z } = new Vector3().setFromSpherical(place);
    this.camera.position.set(x, -z, y).add(this.controls.target);
    this.controls.update();
    this.draw(false);
  }

  /** Come closer (below 1) or go away from the middle. */
  zoom(factor) {
    this.camera.position.sub(this.controls.target).multiplyScalar(factor).add(this.controls.target);
    this.controls.update();
    this.draw(false);
  }

  answerKey(event) {
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    const actions = {
      ArrowLeft: () => this.turn(-TURN, 0),
      ArrowRight: () => this.turn(TURN, 0),
      ArrowUp: () => this.turn(0, TURN),
      ArrowDown: () => this.turn(0, -TURN),
      "+": () => this.zoom(0.9),
      "=": () => this.zoom(0.9),
      "-": () => this.zoom(1 / 0.9),
      Home: () => this.look(this.start),
    };
    if (!(event.key in actions)) return;
    event.preventDefault();
    actions[event.key]();
  }

  /** Return where a point [x, y, z] is on the canvas [CSS px], and whether it is before the camera. */
  project(point) {
    const seen = new Vector3().fromArray(point).project(this.camera);
    const { clientWidth, clientHeight } = this.canvas;
    return { x: ((seen.x + 1) / 2) * clientWidth, y: ((1 - seen.y) / 2) * clientHeight, isAhead: seen.z < 1 };
  }

  /** Call a function with the index of the point (of a list) that a click meets. */
  onSelect(points, listener) {
    let pressed = null;
    this.canvas.addEventListener("pointerdown", (event) => (pressed = [event.clientX, event.clientY]));
    this.canvas.addEventListener("pointerup", (event) => {
      const from = pressed;
      pressed = null;
      if (!from || Math.hypot(event.clientX - from[0], event.clientY - from[1]) > 3) return;
      const box = this.canvas.getBoundingClientRect();
      let best = { distance: NEAREST, index: -1 };
      points.forEach((point, index) => {
        const place = this.project(point);
        const distance = Math.hypot(place.x + box.left - event.clientX, place.y + box.top - event.clientY);
        if (place.isAhead && distance < best.distance) best = { distance, index };
      });
      if (best.index >= 0) listener(best.index);
    });
  }
}
