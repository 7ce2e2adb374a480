// SPDX-License-Identifier: Apache-2.0
// What stands around the canvas: the choice of a pose, layers, directions of view, and the legend.

/** Return an element with text and attributes; text is never read as HTML. */
export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

/** Return a list to choose from; `listener` gets the index, -1 for the first entry. */
export function makeChoice(text, first, labels, listener) {
  const select = make("select");
  select.append(make("option", { value: "-1" }, first));
  labels.forEach((label, i) => select.append(make("option", { value: String(i) }, label)));
  select.addEventListener("change", () => listener(Number(select.value)));
  return { select, field: make("label", {}, `${text} `, select) };
}

/** Return a slider from low to high; `listener` gets its value, and returns what to write beside it. */
export function makeSlider(text, low, high, start, listener) {
  const input = make("input", { type: "range", min: low, max: high, step: "any", value: start });
  const beside = make("span");
  const answer = () => (beside.textContent = listener(Number(input.value)));
  input.addEventListener("input", answer);
  const field = make("label", {}, `${text} `, input, " ", beside);
  return { input, field, answer };
}

/** Return a box to tick that shows and hides shapes. */
export function makeLayer(text, isShown, listener) {
  const box = make("input", { type: "checkbox" });
  box.checked = isShown;
  box.addEventListener("change", () => listener(box.checked));
  return make("label", {}, box, ` ${text}`);
}

/** Return a button. */
export function makeButton(text, listener) {
  const button = make("button", { type: "button" }, text);
  button.addEventListener("click", listener);
  return button;
}

/** Return the colors and what they mean. */
export function makeLegend(entries) {
  const list = make("ul", { class: "legend" });
  for (const { color, text } of entries) {
    const sample = make("span", { class: "sample", "aria-hidden": "true" });
    sample.style.background = color;
    list.append(make("li", {}, sample, ` ${text}`));
  }
  return list;
}
