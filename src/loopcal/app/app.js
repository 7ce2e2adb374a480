// SPDX-License-Identifier: Apache-2.0
// Draws what the server tells of the files, and tells it what people choose. It computes nothing.
"use strict";

const KINDS = { robot: "robot file", data: "measurements", log: "console log", closures: "loop closures", other: "only beside others" };
const STEPS = { import: "Reading the file", calibrate: "Calibrating", report: "Writing the report", export: "Correcting the file", plan: "Planning" };
const QUESTIONS = { length_unit: "Unit of lengths, such as mm", home_height: "Height of the home pose, such as 200mm", platform: "Link that is the platform" };
const NAMES = { "robot.yaml": "Corrected robot file", "robot-not-calibrated.yaml": "Robot file (not calibrated)", "result.json": "Result (JSON)",
  "report.html": "Report", "report.pdf": "Report (PDF)", "report.json": "Report (JSON)", "measurements.csv": "Measurements" };
const WORDS = { back: "Take back", keep: "Use anyway", out: "Leave out", skip: "Another pose" };
const LOST = "loopcal does not answer. Values that you type stay here; it is asked again until it does.";
const ENDED = "loopcal has ended, or was started again. Open the address that it prints now.";

const $ = (id) => document.getElementById(id);
const SETTINGS = document.querySelectorAll("[data-setting]");
const base = (path) => path.split("/").pop();
let state = null, shown = {}, is_all = false, rows = null, is_wanted = false, cause = null;

function h(tag, props = {}, ...children) {
  const { data, ...rest } = props;
  const element = Object.assign(document.createElement(tag), rest);
  for (const [key, value] of Object.entries(data ?? {})) element.setAttribute(key, value);
  element.append(...children.filter((child) => child != null));
  return element;
}

// Replace the content of an element if its facts have changed; the focus stays at the same name.
function draw(id, facts, build) {
  const text = JSON.stringify(facts ?? null);
  if (shown[id] === text) return;
  shown[id] = text;
  const focused = $(id).contains(document.activeElement) ? document.activeElement.getAttribute("data-key") : null;
  $(id).replaceChildren(...[build()].flat().filter((child) => child != null));
  if (focused !== null) ($(id).querySelector(`[data-key="${CSS.escape(focused)}"]`) ?? $("main")).focus();
}

// Pages that commands printed are HTML that loopcal has escaped.
const page = (id, html) => draw(id, html, () => {
  const parsed = h("div", { innerHTML: html ?? "" });
  for (const table of parsed.querySelectorAll("table")) scroll(table);
  return [...parsed.childNodes];
});

function scroll(table) {
  const name = table.caption?.textContent ?? "Table";
  const place = h("div", { className: "table", tabIndex: 0, data: { role: "region", "aria-label": name } });
  table.replaceWith(place);
  place.append(table);
  return place;
}

function warn(text) {
  if ($("alert").textContent !== text) $("alert").textContent = text;
}

async function ask(path, body, method = "POST") {
  try {
    const answer = await fetch(path, { method, body: method === "POST" ? JSON.stringify(body ?? {}) : body });
    const text = await answer.text();
    const error = answer.ok ? "" : JSON.parse(text).error;
    if (path !== "correct") warn(error);
    return error || null;
  } catch {
    warn(LOST);
    return LOST;
  }
}

async function upload(files) {
  for (const file of files) {
    if (file.size > (state?.most ?? Infinity)) warn(`${file.name} has ${Math.ceil(file.size / 1e6)} MB. The page takes at most ${state.most / 1e6} MB.`);
    else if (await ask(encodeURIComponent(file.name), file, "PUT")) return;
  }
}

const choice = (options, value, props) => h("select", props, ...Object.entries(options).map(([key, text]) =>
  h("option", { value: key, textContent: text, selected: key === value })));

function drawFiles() {
  const formats = Object.fromEntries(state.formats.map((name) => [name, `file of ${name}`]));
  const begun = () => h("li", {}, h("b", { textContent: "Rows that were measured here" }),
    h("button", { textContent: "Remove", ariaLabel: "Remove the rows that were measured here", data: { "data-key": "session" }, onclick: () => ask("discard") }));
  draw("list", [state.kinds, state.unused, state.is_begun], () => [state.is_begun ? begun() : null, ...Object.entries(state.kinds).map(([name, kind]) => h("li", {},
    h("b", { textContent: name }, state.unused.includes(name) ? h("span", { className: "soft", textContent: " not used" }) : null),
    choice({ ...KINDS, ...formats }, kind, { ariaLabel: `Kind of ${name}`, data: { "data-key": `kind ${name}` },
      onchange: (event) => ask("change", { kinds: { [name]: event.target.value } }) }),
    h("button", { textContent: "Remove", ariaLabel: `Remove ${name}`, data: { "data-key": name }, onclick: () => ask("change", { remove: name }) })))]);
  draw("questions", state.questions, () => state.questions.map((key) => h("label", {},
    QUESTIONS[key] ?? `Noise (${key.replace("sigma_", "")}), such as 0.02mm`,
    h("input", { value: state.settings[key] ?? "", size: 12, onchange: (event) => ask("change", { settings: { [key]: event.target.value } }) }))));
  draw("robot", state.robots, () => ["", ...state.robots].map((name) => h("option", { value: name, textContent: name || "none" })));
  $("shipped").hidden = Boolean(state.robot) && !state.robots.includes(state.robot);
  for (const select of SETTINGS)
    if (document.activeElement !== select) select.value = state.settings[select.dataset.setting] ?? "";
  const missing = [state.robot ? "" : "a machine", state.data.length ? "" : "measurements"].filter(Boolean);
  $("need").textContent = missing.length ? `Still needed: ${missing.join(" and ")}.` : "";
}

function drawResult() {
  const is_done = "calibrate" in state.pages && state.pages.calibrate;
  $("result").hidden = !is_done;
  $("stale").hidden = !state.edits;
  page("verdict", state.pages.calibrate);
  const is_good = $("verdict").textContent.startsWith("Calibrated:");
  $("verdict").className = state.codes.calibrate ? "failed" : is_good ? "" : "doubt";
  page("export-page", state.pages.export);
  page("import-page", state.pages.import);
  page("plan-page", state.pages.plan);
  for (const [id, name] of [["changes", "export"], ["import", "import"]]) $(id).hidden = !state.pages[name];
  draw("downloads", state.downloads, () => [
    ...state.downloads.map((path) => h("a", { className: "button", href: path.split("/").map(encodeURIComponent).join("/"), download: base(path), data: { "data-key": path } },
      path.startsWith("result/files/") && !NAMES[base(path)] ? `Corrected ${base(path)}` : NAMES[base(path)] ?? base(path))),
    h("button", { textContent: "Print the report to PDF", data: { "data-key": "pdf" }, onclick: () => ask("print_report") })]);
  const report = state.downloads.find((path) => path.endsWith("report.html"));
  $("reports").hidden = !report;
  draw("report", report && [report, state.runs], () => report ? [
    h("p", {}, h("a", { href: `${report}?show=1`, target: "_blank", textContent: "Open the report in a tab of its own" })),
    h("iframe", { src: `${report}?show=1&run=${state.runs}`, title: "Report of the calibration", data: { sandbox: "allow-scripts" } })] : []);
}

async function loadRows() {
  const facts = JSON.stringify([state.data, state.dropped, state.runs, state.edits, state.progress !== null, state.session !== null, is_all, $("sorted").checked]);
  if (shown.rows === facts) return;
  shown.rows = facts;
  if (state.session || state.progress) return;
  const answer = await fetch(`rows?all=${Number(is_all)}&sorted=${Number($("sorted").checked)}`);
  rows = answer.ok ? await answer.json() : null;
  drawRows();
}

function drawRows() {
  const count = rows ? rows.tables.length : 0;
  $("rows").hidden = !count;
  draw("tables", rows, () => (rows?.tables ?? []).flatMap((table) => drawTable(table)));
}

function drawTable(table) {
  const { most, count } = table;
  const body = table.rows.map(([line, pose, cells, sigma, text]) => {
    const is_out = rows.dropped.includes(pose), key = `${table.file} ${line}`;
    const use = h("input", { type: "checkbox", checked: !is_out, ariaLabel: `Use pose ${pose}`, data: { "data-key": `use ${key}` },
      onchange: (event) => ask("leave_out", { pose, is_out: !event.target.checked }) });
    const bar = h("span", { className: `bar${sigma > 3 ? " large" : ""}` });
    bar.style.width = `${(5 * (sigma ?? 0)) / most}rem`;
    const note = rows.held_out.includes(pose) ? "held out" : is_out ? "left out" : sigma == null ? "" : `${sigma.toFixed(1)} sigma`;
    return h("tr", { className: is_out ? "out" : "" }, h("th", { scope: "row", textContent: pose }), h("td", { textContent: text }),
      h("td", {}, note, sigma == null ? null : bar), h("td", {}, use),
      h("td", {}, h("button", { textContent: "Correct", ariaLabel: `Correct the row of pose ${pose}`, data: { "data-key": key },
        onclick: () => correct(table, line, pose, cells) })));
  });
  const head = ["pose", "largest residual", "size", "use", "values"].map((text) => h("th", { scope: "col", textContent: text }));
  const drawn = h("table", {}, h("caption", { textContent: `${base(table.file)}: ${count} rows` }),
    h("thead", {}, h("tr", {}, ...head)), h("tbody", {}, ...body));
  const place = h("div", {}, drawn);
  scroll(drawn);
  if (count > body.length && !is_all) place.append(h("button", { textContent: "Show more rows", onclick: () => { is_all = true; loadRows(); } }));
  return [place];
}

function correct(table, line, pose, cells) {
  $("dialog-title").textContent = `Correct the row of pose ${pose}`;
  $("dialog-error").textContent = "";
  const fields = table.header.map((name, i) => h("input", { value: cells[i], name }));
  $("cells").replaceChildren(...fields.map((field) => h("label", {}, field.name, field)));
  const form = $("dialog").querySelector("form");
  form.onsubmit = async (event) => {
    if (event.submitter?.value !== "save") return;
    event.preventDefault();
    for (const [column, field] of fields.entries()) {
      if (field.value === cells[column]) continue;
      const error = await ask("correct", { file: table.file, line, column, text: field.value });
      if (error) { $("dialog-error").textContent = error; field.focus(); return; }
      cells[column] = field.value;
    }
    $("dialog").close();
  };
  $("dialog").showModal();
}

function drawSession() {
  const session = state.session;
  $("companion").hidden = !session;
  document.body.classList.toggle("measuring", Boolean(session));
  if (!session) return;
  is_wanted = false;
  $("pose-title").textContent = session.pose === null ? "All poses are measured" : `Pose ${session.pose}`;
  const parts = session.command[0]?.split(": ").slice(1).join(": ").split(", ") ?? [];
  $("finish").className = session.pose === null ? "main" : "";
  draw("command", session.command, () => parts.map((part) => h("li", { textContent: part.replace(/=(-?[\d.]+)/, " = $1 ") })));
  draw("row", [session.headers, session.pose, session.visits.length], () => session.pose === null ? [] : [
    ...session.headers.map((name, i) => h("label", {}, name, h("input", { inputMode: "decimal", autocomplete: "off", data: { "data-key": `field ${i}` } }))),
    h("button", { className: "main", textContent: "Record" })]);
  draw("words", [session.poses, session.visits.length, session.pose], () => [
    ...Object.entries(WORDS).map(([word, text]) => h("button", { type: "button", textContent: text, data: { "data-key": word },
      disabled: word === "skip" ? session.pose === null : !session.visits.length, onclick: () => ask("tell", { word }) })),
    choice(Object.fromEntries([["", "Choose a pose"], ...session.poses.map((pose) => [`pose ${pose}`, `pose ${pose}`])]), "",
      { ariaLabel: "Pose to measure next", onchange: (event) => event.target.value && ask("tell", { word: event.target.value }) })]);
  page("said", session.said);
  $("said").className = session.visits.at(-1)?.is_used === false ? "doubt" : "";
  draw("visits", session.visits, () => {
    const body = [...session.visits].reverse().map((visit) => h("tr", { className: visit.is_used === false ? "out" : "" },
      h("th", { scope: "row", textContent: visit.pose }), ...Object.values(visit.cells).map((cell) => h("td", { textContent: cell.length > 9 ? Number(cell).toPrecision(7) : cell })),
      h("td", { textContent: visit.is_used === false ? "left out" : "used" })));
    const head = ["pose", ...session.headers, "row"].map((text) => h("th", { scope: "col", textContent: text }));
    const table = h("table", {}, h("caption", { textContent: "Rows so far, the last one first" }),
      h("thead", {}, h("tr", {}, ...head)), h("tbody", {}, ...body));
    const place = h("div", {}, table);
    scroll(table);
    return body.length ? [place] : [];
  });
}

function drawProgress() {
  const progress = state.progress;
  $("progress").hidden = !progress;
  if (progress) {
    const [what, done, total] = progress, bar = $("progress").querySelector("progress");
    const text = `${STEPS[what] ?? what} …`;
    if ($("doing").textContent !== text) $("doing").textContent = text;
    if (total > 1) { bar.max = total; bar.value = done; } else bar.removeAttribute("value");
  }
  const is_open = state.robot && state.data.length && !progress;
  $("calibrate").disabled = !is_open;
  $("measure").disabled = !state.robot || progress || !(state.data.length || state.downloads.includes("plan/measurements.csv"));
  for (const control of $("files").querySelectorAll("input, select, button")) control.disabled = Boolean(progress);
  draw("messages", state.messages, () => state.messages.map((line) => {
    const [, kind, text] = /^(?:loopcal: )?(note|quality gate not met|Hint)?(?:: )?(.*)$/s.exec(line);
    const label = { note: "note", Hint: "hint", "quality gate not met": "gate" }[kind] ?? "error";
    return h("li", {}, h("span", { className: `label ${label === "note" || label === "hint" ? "" : "failure"}`, textContent: label }), h("span", { textContent: text }));
  }));
}

// The focus leaves a control that is disabled or hidden for what takes its place.
function keepFocus(focused) {
  const is_there = (place) => place?.isConnected && !place.disabled && place.checkVisibility();
  const now = document.activeElement;
  if (focused === document.body || (is_there(now) && now !== document.body && now !== $("main"))) return;
  if (state.progress) cause = focused;
  const after = cause === $("calibrate") ? [$("result-title"), $("messages"), cause] : [cause, $("messages")];
  [$("stop"), $("row").querySelector("input"), $("pose-title"), ...after, $("main")].find(is_there).focus();
}

function drawAll() {
  const focused = document.activeElement;
  const name = state.program ?? state.robot;
  $("machine").textContent = name ? base(name) : "";
  document.title = name ? `${base(name)} - loopcal` : "loopcal";
  document.body.classList.toggle("has-files", state.is_begun || Object.keys(state.kinds).length > 0);
  drawFiles();
  drawResult();
  drawSession();
  drawProgress();
  keepFocus(focused);
  loadRows();
  if (is_wanted && !state.progress && "import" in state.pages) { // the machine's file has been read
    is_wanted = false;
    if (!state.codes.import) ask("measure");
  }
}

function listen() {
  const events = new EventSource("events");
  events.onmessage = (event) => {
    if ([LOST, ENDED].includes($("alert").textContent)) warn("");
    state = JSON.parse(event.data);
    drawAll();
  };
  events.onerror = () => warn(events.readyState === EventSource.CLOSED ? ENDED : LOST);
}

$("choose").onchange = (event) => { upload([...event.target.files]).then(() => { event.target.value = ""; }); };
for (const kind of ["dragover", "dragleave", "drop"]) document.addEventListener(kind, (event) => {
  event.preventDefault();
  $("drop").classList.toggle("over", kind === "dragover");
  if (kind === "drop") upload([...event.dataTransfer.files]);
});
for (const select of SETTINGS)
  select.onchange = () => ask("change", { settings: { [select.dataset.setting]: select.value } });
$("calibrate").onclick = () => ask("calibrate");
$("stop").onclick = () => ask("stop");
$("measure").onclick = async () => { is_wanted = !await ask("measure"); };
$("finish").onclick = () => { cause = $("calibrate"); ask("finish"); };
$("sorted").onchange = loadRows;
$("plan").onsubmit = (event) => { event.preventDefault(); ask("plan", Object.fromEntries(new FormData(event.target))); };
$("row").onsubmit = async (event) => {
  event.preventDefault();
  if ($("row").ariaBusy === "true") return; // the values of this pose are on their way
  const values = [...$("row").querySelectorAll("input")].map((field) => field.value.trim());
  $("row").ariaBusy = "true";
  await ask("tell", { pose: state.session.pose, values });
  $("row").ariaBusy = "false";
  $("row").querySelector("input")?.focus();
};
if (location.search.includes("token")) history.replaceState(null, "", location.pathname);
listen();
