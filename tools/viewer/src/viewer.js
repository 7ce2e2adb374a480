// SPDX-License-Identifier: Apache-2.0
// The interactive 3-D view of a report. Each figure with a scene has a picture, which stays where
// the browser has no WebGL, and on paper. Nothing moves by itself and nothing is loaded.

import { Group } from "three";
import { addScaled, findBounds, pointOf, readScene, roundDown } from "./data.js";
import { make, makeButton, makeChoice, makeLayer, makeLegend, makeSlider } from "./panel.js";
import { Robot } from "./robot.js";
import { Arrows, Points, makeLines, makeSolid } from "./shapes.js";
import { Stage } from "./stage.js";

const KEYS = "Drag to rotate, scroll to zoom. Keyboard: arrow keys rotate, + and - zoom, Home resets.";
const GRID = "#d5dae0";
const LIVE = "live"; // class of a figure whose picture the view replaces

/** Return lines of a square grid below a scene, and the length of a square. */
function makeGrid(bounds, scene) {
  const span = Math.max(bounds.high[0] - bounds.low[0], bounds.high[1] - bounds.low[1], scene.size);
  const step = roundDown(span / 6);
  const [x0, y0] = [0, 1].map((k) => Math.floor(bounds.low[k] / step) * step);
  const [x1, y1] = [0, 1].map((k) => Math.ceil(bounds.high[k] / step) * step);
  const z = bounds.low[2] - 0.02 * scene.size;
  bounds.floor = z;
  const points = [];
  for (let i = 0; i <= Math.round((x1 - x0) / step); i++) points.push(x0 + i * step, y0, z, x0 + i * step, y1, z);
  for (let i = 0; i <= Math.round((y1 - y0) / step); i++) points.push(x0, y0 + i * step, z, x1, y0 + i * step, z);
  bounds.points.push([x0, y0, z], [x0, y1, z], [x1, y0, z], [x1, y1, z]);
  return { lines: makeLines(points, GRID), step };
}

/** Return a number with this many significant digits, without an exponent. */
function format(value, digits = 3) {
  if (!Number.isFinite(value)) return "not known";
  if (value === 0) return "0";
  const places = digits - 1 - Math.floor(Math.log10(Math.abs(value)));
  return value.toFixed(Math.min(Math.max(places, 0), 12));
}

/** Return the sentence on a choice of the list of poses. */
function describePose(scene, choice) {
  if (choice < 0) return "The robot is at its home pose.";
  const { labels, rows, tools, errors } = scene.poses;
  const index = rows[choice];
  const places = Math.max(0, 4 - Math.floor(Math.log10(scene.size)));
  const place = pointOf(tools, index).map((value, k) => `${"xyz"[k]} ${value.toFixed(places)}`);
  const error = Math.hypot(...pointOf(errors, index));
  return `Pose ${labels[choice]}: tool at ${place.join(", ")} ${scene.unit}; error before calibration ${format(error)} ${scene.unit}.`;
}

/** Return the groups of poses, errors and the map. */
function makeLayers(scene, thickness) {
  const { tools, errors, magnification, colors } = scene.poses;
  const count = tools.length / 3;
  const poses = new Points(new Array(count).fill(colors.pose), new Array(count).fill(0.5 * thickness), false, false);
  const arrows = new Arrows(count, colors.error, 0.3 * thickness);
  for (let i = 0; i < count; i++) poses.place(i, pointOf(tools, i));
  const scale = (factor) => {
    for (let i = 0; i < count; i++) arrows.place(i, pointOf(tools, i), addScaled(pointOf(tools, i), pointOf(errors, i), factor));
  };
  scale(magnification);
  const layers = { poses: new Group(), errors: new Group(), map: new Group() };
  if (count) {
    layers.poses.add(poses.mesh);
    layers.errors.add(...arrows.meshes);
  }
  if (scene.map) {
    const { points, colors: shades, hull, largest } = scene.map;
    const map = new Points(shades, new Array(shades.length).fill(0.3 * thickness), true, false);
    shades.forEach((_, i) => map.place(i, pointOf(points, i)));
    const mark = new Points([shades[largest.index]], [1.4 * thickness], false);
    mark.place(0, pointOf(points, largest.index));
    layers.map.add(map.mesh, mark.mesh);
    if (hull.length) layers.map.add(makeSolid(points, hull, shades));
  }
  return { layers, scale };
}

/** Return the controls of a second robot, which shows the motions of a scene larger than they are. */
function controlMotions(scene, ghost, stage, said) {
  const moved = new Float32Array(scene.home.length);
  let shown = null;
  let began = 0; // time of the first picture of a motion that plays; 0 where none plays
  ghost.group.visible = false;
  const place = (share) => {
    for (let i = 0; shown && i < moved.length; i++) moved[i] = scene.home[i] + share * shown.shift[i];
    ghost.group.visible = Boolean(shown);
    if (shown) ghost.show(moved, 0);
    stage.draw();
    return shown ? `x ${format(share * shown.magnification, 2)}` : "";
  };
  const slider = makeSlider("magnified", -1, 1, 1, place);
  const play = makeButton("play", () => {
    began = began ? 0 : performance.now();
    play.textContent = began ? "stop" : "play";
    if (began) requestAnimationFrame(move);
  });
  const move = (time) => {
    if (!began) return;
    slider.input.value = Math.cos((time - began) / 600);
    slider.answer();
    requestAnimationFrame(move);
  };
  const names = scene.motions.map(({ name }) => name);
  const choice = makeChoice("Second robot", "none", names, (index) => {
    shown = index < 0 ? null : scene.motions[index];
    slider.input.value = 1;
    said.textContent = shown ? shown.text : "";
    for (const element of [slider.field, play]) element.hidden = !shown;
    if (!shown && began) play.click();
    slider.answer();
  });
  choice.select.dispatchEvent(new Event("change"));
  return [choice.field, slider.field, play];
}

/** Return the entries of the legend. */
function listMeanings(scene, step) {
  const entries = scene.legend.map(({ color, text }) => ({ color, text }));
  entries.push({ color: GRID, text: `grid: ${step} ${scene.unit}` });
  return entries;
}

/** Write names beside points of the canvas, again after each drawing. */
function attachNames(stage, overlay, names) {
  const written = names.map(({ text, color, point, layer }) => {
    const element = make("span", {}, text);
    element.style.color = color;
    overlay.append(element);
    return { element, point, layer };
  });
  stage.onDraw(() => {
    for (const { element, point, layer } of written) {
      const { x, y, isAhead } = stage.project(point);
      element.hidden = !isAhead || layer?.visible === false;
      element.style.transform = `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px)`;
    }
  });
}

/** Replace the picture of a figure by the view of its scene; an error where there is no WebGL. */
function open(figure) {
  const scene = readScene(figure.querySelector("script"));
  const bounds = findBounds(scene);
  const start = scene.planar ? "above" : "perspective";
  const canvas = make("canvas", {
    tabindex: "0", role: "application", "aria-label": `3-D view of ${scene.name}. ${KEYS}`,
    "aria-describedby": figure.dataset.description,
  });
  const { lines, step } = makeGrid(bounds, scene);
  const stage = new Stage(canvas, bounds, start);
  const thickness = 0.011 * scene.size;
  const robot = new Robot(scene, thickness);
  const { layers, scale } = makeLayers(scene, thickness);
  const ghost = new Robot(scene, 0.9 * thickness, scene.poses.colors.error);
  const marker = new Points([scene.poses.colors.pose], [1.1 * thickness], false, false);
  marker.mesh.visible = false;
  layers.map.visible = false;
  stage.scene.add(robot.group, ghost.group, lines, marker.mesh, ...Object.values(layers));

  const said = make("output", {}, describePose(scene, -1));
  const { labels, rows, tools, robots } = scene.poses;
  const choice = makeChoice("Robot at pose", "home", labels, (index) => {
    robot.show(index < 0 ? scene.home : robots, Math.max(index, 0) * robot.count);
    marker.mesh.visible = index >= 0;
    if (index >= 0) marker.place(0, pointOf(tools, rows[index]));
    said.textContent = describePose(scene, index);
    stage.draw();
  });
  const controls = make("div", { class: "controls", role: "group", "aria-label": "3-D view" });
  if (labels.length) controls.append(choice.field);
  const toggle = (name) => (isShown) => {
    layers[name].visible = isShown;
    stage.draw();
  };
  if (tools.length) {
    const slider = makeSlider("errors magnified", -1, 1, 0, (power) => {
      const factor = Number((scene.poses.magnification * 10 ** power).toPrecision(2));
      scale(factor);
      stage.draw();
      return `x ${factor}`;
    });
    slider.answer();
    controls.append(makeLayer("poses", true, toggle("poses")), makeLayer("errors", true, toggle("errors")), slider.field);
  }
  if (scene.map) controls.append(makeLayer("uncertainty over the workspace", false, toggle("map")));
  for (const name of ["perspective", "above", "front", "right"]) {
    controls.append(makeButton(name === "perspective" ? "reset view" : `from ${name === "right" ? "the right" : name === "front" ? "the front" : name}`,
      () => stage.look(name === "perspective" ? start : name)));
  }
  const told = make("span", { "aria-live": "polite" });
  if (scene.motions.length) controls.append(...controlMotions(scene, ghost, stage, told));
  const overlay = make("div", { class: "names", "aria-hidden": "true" });
  const place = make("div", { class: "place" }, canvas, overlay);
  const view = make("div", { class: "viewer" }, place, controls);
  if (labels.length) view.append(make("p", {}, said));
  if (scene.motions.length) view.append(make("p", {}, told));
  view.append(makeLegend(listMeanings(scene, step)), make("p", {}, KEYS));
  figure.prepend(view);
  figure.classList.add(LIVE);
  canvas.addEventListener("webglcontextlost", () => {
    figure.classList.remove(LIVE);
    view.remove();
  });

  const names = [...scene.names];
  if (scene.map) {
    const { index, text } = scene.map.largest;
    names.push({ text, color: "#1b1f24", point: pointOf(scene.map.points, index), layer: layers.map });
  }
  attachNames(stage, overlay, names);
  stage.onSelect(
    rows.map((row) => pointOf(tools, row)),
    (index) => {
      choice.select.value = String(index);
      choice.select.dispatchEvent(new Event("change"));
    },
  );
  const fit = () => stage.resize(place.clientWidth, Math.round(Math.min(0.66 * place.clientWidth, 560)));
  fit();
  stage.look(start);
  new ResizeObserver(fit).observe(place);
}

/** Open the view of a figure when it is first near the screen; without WebGL its picture stays. */
function openWhenSeen(figure) {
  const observer = new IntersectionObserver(
    (entries) => {
      if (!entries.some((entry) => entry.isIntersecting)) return;
      observer.disconnect();
      try {
        open(figure);
      } catch (error) {
        if (error.message !== "no WebGL") throw error;
      }
    },
    { rootMargin: "200px" },
  );
  observer.observe(figure);
}

for (const figure of document.querySelectorAll("figure.scene")) openWhenSeen(figure);
