"use strict";
// The scope: every tick of the run, or of a log, around a trigger.

const SCOPE_MS = 200;
const ROLL_POINTS = 4000;
const PANE_HEIGHT = 190;
const MOST_FIELDS = 12;
const MOST_MARKS = 20;
const MARK_S = 1; // so far to each side of a mark is shown
const COLOURS = ["--c0", "--c1", "--c2", "--c3"];
const FIRST_LAYOUT = [["position_m", "reference_m"], ["error_m"], ["valve_v"]];
const INT_MAX = 2 ** 52;
const COLUMNS = 4000; // of a picture at most: finer than a screen

const store = {
  read: (name, otherwise) => {
    try { return JSON.parse(localStorage.getItem(`pamctl.${name}`)) ?? otherwise; } catch { return otherwise; }
  },
  write: (name, value) => { try { localStorage.setItem(`pamctl.${name}`, JSON.stringify(value)); } catch { /* private window */ } },
};

const scope = {
  mode: "roll", // roll, single, normal, auto, still
  rateHz: 1000,
  log: "", after: null, armed: "", found: null, sinceMs: 0,
  held: null, // what the server holds
  capture: null, // { log, trigger, t0, ticks, t, raw, events }
  view: null, // [from, to] in seconds, null shows all
  cursors: [null, null], // indices of samples
  panes: store.read("panes", FIRST_LAYOUT),
  charts: [],
};

// --- units: SI comes in; mm, um and kPa are shown -------------------------------------------------

function shownUnit(name) {
  if (/^error_m$/.test(name)) return { factor: 1e6, unit: "\u00b5m" };
  if (/_m$/.test(name)) return { factor: 1e3, unit: "mm" };
  if (/_pa$/.test(name)) return { factor: 1e-3, unit: "kPa" };
  if (/^(late|dt|read|compute|write)_s$/.test(name)) return { factor: 1e6, unit: "\u00b5s" };
  const found = /_(v|s|ns|m_per_s[23]?)$/.exec(name);
  const units = { v: "V", s: "s", ns: "ns", m_per_s: "m/s", m_per_s2: "m/s\u00b2", m_per_s3: "m/s\u00b3" };
  return { factor: 1, unit: found ? units[found[1]] : "" };
}

function shownNumber(value) {
  if (value === null || value === undefined || Number.isNaN(value)) return "-";
  return Number(value.toPrecision(6)).toString().replace(/^-/, "\u2212");
}

// --- what the server is asked ----------------------------------------------------------------------

async function ask(path, query) {
  const answer = await fetch(`${path}?${new URLSearchParams(query)}`, { priority: "low", signal: AbortSignal.timeout(60000) });
  if (!answer.ok) throw new Error((await answer.json()).error);
  return answer;
}

async function fetchColumns(log, first, last, names, every = 1) {
  const body = await (await ask("/scope/ticks", { log, first, last, every, fields: names.join(",") })).arrayBuffer();
  const all = new Float64Array(body), count = all.length / names.length;
  return Object.fromEntries(names.map((name, at) => [name, all.subarray(at * count, (at + 1) * count)]));
}

const wantedFields = () => [...new Set(scope.panes.flat())];

async function loadCapture(stretch, every = 1) {
  const raw = await fetchColumns(stretch.log, stretch.first, stretch.last, ["tick", "t_s", ...wantedFields()], every);
  if (!raw.tick.length) return;
  const at = stretch.trigger === null ? -1 : raw.tick.indexOf(stretch.trigger);
  const t0 = at >= 0 ? raw.t_s[at] : stretch.trigger === null ? 0 : raw.t_s[0];
  showCapture({ ...stretch, raw, t0, every, ticks: raw.tick, t: raw.t_s.map((t) => t - t0),
    events: stretch.events ?? (scope.held?.log === stretch.log ? scope.held.events : []) });
}

// --- the trigger -----------------------------------------------------------------------------------

const number = (id) => Number(byId(id).value);
const ticksOf = (seconds) => Math.round(seconds * scope.rateHz);

function arm() {
  Object.assign(scope, { after: scope.held ? scope.held.last_tick : null, armed: "", found: null, sinceMs: performance.now(), log: scope.held?.log ?? "" });
}

async function searchTrigger(held) {
  if (held.log !== scope.log || scope.after === null) Object.assign(scope, { log: held.log, after: -1, armed: "", found: null });
  if (!held.log) return;
  if (scope.found === null) {
    const field = byId("tfield").value;
    const { factor } = shownUnit(field);
    const query = { log: held.log, field, level: number("tlevel") / factor, slope: byId("tslope").value,
      hysteresis: number("thyst") / factor, after: scope.after, armed: scope.armed };
    const result = await (await ask("/scope/trigger", query)).json();
    Object.assign(scope, { found: result.tick, armed: result.armed, after: result.searched });
  }
  const { found } = scope;
  if (found === null) return waitForTrigger(held);
  const last = found + ticksOf(number("tpost"));
  const isOver = performance.now() - scope.grewMs > 1500; // the run has ended
  if (held.last_tick < last && !isOver) {
    sayScope(`triggered; filling ${Math.max(0, Math.round(100 * (held.last_tick - found) / (last - found)))} %`);
    return;
  }
  const first = Math.max(0, found - ticksOf(number("tpre")));
  await loadCapture({ log: held.log, first: Math.max(first, held.first_tick), last, trigger: found });
  sayScope(`triggered at tick ${found}. ${tellUnseen(held)}${held.first_tick > first ? "the ticks that are held begin later" : ""}`);
  if (scope.mode === "single") setMode("still");
  Object.assign(scope, { found: null, armed: "", after: Math.max(last, found + ticksOf(number("tholdoff"))), sinceMs: performance.now() });
}

function tellUnseen({ unseen }) {
  return unseen ? `${unseen} ticks of this run came too fast for this PC to show: the log has them` : "";
}

async function waitForTrigger(held) {
  const spanS = number("tpre") + number("tpost");
  if (scope.mode === "auto" && performance.now() - scope.sinceMs > Math.max(500, spanS * 1e3)) {
    await roll(held, spanS);
    sayScope("auto: no trigger");
  } else sayScope("waiting for the trigger");
}

async function roll(held, spanS) {
  const count = ticksOf(spanS);
  const every = Math.max(1, Math.ceil(count / ROLL_POINTS));
  await loadCapture({ log: held.log, first: Math.max(held.first_tick, held.last_tick - count), last: held.last_tick, trigger: null }, every);
}

async function stepScope() {
  try {
    if (scope.mode !== "still" && !document.hidden) {
      const held = await (await ask("/scope/state", {})).json();
      const isNew = held.last_tick !== scope.held?.last_tick || held.log !== scope.held?.log || !scope.capture;
      if (isNew) scope.grewMs = performance.now();
      scope.held = held;
      if (held.problem) sayScope(held.problem);
      else if (held.last_tick < held.first_tick) sayScope("no run is logged");
      else if (scope.mode === "roll") {
        if (isNew && inSight.has(byId("panes"))) await roll(held, number("tpre") + number("tpost"));
        sayScope(performance.now() - scope.grewMs > 1500 ? `the run is over: ${held.log}` : tellUnseen(held));
      } else await searchTrigger(held);
    }
  } catch (error) {
    sayScope(error.message);
  }
}

function sayScope(text) {
  if (byId("scopestate").textContent !== text) byId("scopestate").textContent = text;
}

function setMode(mode) {
  scope.mode = mode;
  for (const button of document.querySelectorAll("[data-mode]")) button.setAttribute("aria-pressed", String(button.dataset.mode === mode));
  if (mode !== "still") {
    scope.view = null;
    scope.cursors = [null, null];
    arm();
  }
}

// --- panes -----------------------------------------------------------------------------------------

const fullRange = () => (scope.capture ? [scope.capture.t[0], Math.max(scope.capture.t.at(-1), scope.capture.t[0] + 1e-6)] : [0, 1]);
const viewRange = () => scope.view ?? fullRange();

function findGaps(chart, _series, first, last, found) {
  const times = chart.data[0], gaps = [...found];
  const longest = Math.max(0.02, 5 * (scope.capture?.every ?? 1) * (scope.capture?.perColumn ?? 1) / scope.rateHz);
  for (let at = first + 1; at <= last; at++) {
    if (times[at] - times[at - 1] > longest) gaps.push([chart.valToPos(times[at - 1], "x", true), chart.valToPos(times[at], "x", true)]);
  }
  return gaps.sort((a, b) => a[0] - b[0]);
}

function drawLines(chart) {
  const { capture } = scope;
  if (!capture) return;
  const { ctx, bbox } = chart;
  const line = (t, name, dash, label, row = 0) => {
    const x = chart.valToPos(t, "x", true);
    if (!(x >= bbox.left && x <= bbox.left + bbox.width)) return;
    ctx.strokeStyle = ctx.fillStyle = colour(name);
    ctx.setLineDash(dash);
    ctx.beginPath();
    ctx.moveTo(x, bbox.top);
    ctx.lineTo(x, bbox.top + bbox.height);
    ctx.stroke();
    const isRight = x > bbox.left + 0.7 * bbox.width;
    ctx.textAlign = isRight ? "right" : "left";
    ctx.font = `${12 * devicePixelRatio}px system-ui, sans-serif`;
    ctx.fillText(label, x + (isRight ? -3 : 3) * devicePixelRatio, bbox.top + 12 * (row + 1) * devicePixelRatio);
  };
  ctx.save();
  ctx.lineWidth = devicePixelRatio;
  for (const [k, event] of capture.events.entries()) {
    if (event.tick < capture.ticks[0] || event.tick > capture.ticks.at(-1)) continue;
    const at = nearestIndex(capture.ticks, event.tick);
    line(capture.t[at], "--dim", [2, 3], spellEvent(event).slice(0, 36), 1 + k % 4);
  }
  if (capture.trigger !== null) line(0, "--warn", [6, 4], "T");
  scope.cursors.forEach((at, which) => at !== null && line(capture.t[at], "--fg", [], "AB"[which]));
  ctx.restore();
}

function placeCursor(which, index) {
  if (!scope.capture) return;
  if (scope.mode !== "still") setStill();
  scope.cursors[which] = Math.min(Math.max(index, 0), scope.capture.t.length - 1);
  refreshScope();
}

// The live view may leave ticks out; what stands still has every tick.
function setStill() {
  setMode("still");
  sayScope("paused");
  const { capture } = scope;
  if (capture?.log && capture.every > 1) loadCapture(capture, 1).catch((error) => sayScope(error.message));
}

function setView(from, to) {
  if (!scope.capture) return;
  if (scope.mode !== "still") setStill();
  const [low, high] = fullRange();
  const span = Math.min(to - from, high - low);
  const start = Math.min(Math.max(from, low), high - span);
  scope.view = [start, start + span];
  refreshScope();
}

function moveView(zoom, shift) {
  const [from, to] = viewRange(), span = (to - from) * zoom, middle = (from + to) / 2 + shift * (to - from);
  setView(middle - span / 2, middle + span / 2);
}

function buildPanes() {
  for (const { chart } of scope.charts) chart.destroy();
  byId("panes").replaceChildren();
  scope.charts = scope.panes.map(buildPane);
  refreshScope();
}

function buildPane(names, at) {
  const box = element("div", "plot", "");
  const title = element("div", "ptitle", "");
  names.forEach((name, k) => {
    const key = element("button", `key k${k % 4}`, `${name} ${shownUnit(name).unit}`);
    key.type = "button";
    key.title = "remove this field";
    key.setAttribute("aria-label", `${key.textContent}: remove it from pane ${at + 1}`);
    key.addEventListener("click", () => changePanes((panes) => panes[at].splice(k, 1)));
    title.append(key);
  });
  const add = element("select", "add", "");
  add.setAttribute("aria-label", `add a field to pane ${at + 1}`);
  add.append(new Option("+ field", ""), ...bench.fields.map(({ name }) => new Option(name, name)));
  add.addEventListener("change", () => changePanes((panes) => panes[at].push(add.value)));
  title.append(add);
  box.append(title);
  byId("panes").append(box);
  const chart = new uPlot({
    width: box.clientWidth || 300, height: PANE_HEIGHT, legend: { show: false }, pxAlign: 0,
    cursor: { sync: { key: "scope" }, drag: { x: true, y: false, setScale: false }, y: false },
    scales: { x: { time: false, range: viewRange }, y: { range: yRange } },
    series: [{}, ...names.map((name, k) => ({ label: name, stroke: () => colour(COLOURS[k % 4]), width: 1.5, points: { show: false }, gaps: findGaps }))],
    axes: [axis({ size: 26, values: (_, ticks) => ticks.map((v) => `${Number(v.toPrecision(9))} s`) }), axis({ size: 64 })],
    hooks: { draw: [drawLines], setSelect: [(u) => {
      if (u.select.width < 5) return;
      const { left, width } = u.select;
      u.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
      setView(u.posToVal(left, "x"), u.posToVal(left + width, "x"));
    }] },
  }, [[], ...names.map(() => [])], box);
  describePlot(chart, names.join(", "));
  let pressedX = 0;
  chart.over.addEventListener("mousedown", (event) => { pressedX = event.clientX; });
  chart.over.addEventListener("click", (event) => {
    if (Math.abs(event.clientX - pressedX) > 4 || !scope.capture) return;
    const left = event.clientX - chart.over.getBoundingClientRect().left;
    const which = event.shiftKey || byId("placeb").checked ? 1 : 0;
    placeCursor(which, nearestIndex(scope.capture.t, chart.posToVal(left, "x")));
  });
  chart.over.addEventListener("dblclick", () => { scope.view = null; refreshScope(); });
  new ResizeObserver(() => chart.setSize({ width: box.clientWidth, height: PANE_HEIGHT })).observe(box);
  return { chart, names };
}

async function changePanes(change) {
  const panes = scope.panes.map((names) => [...names]);
  change(panes);
  const kept = panes.filter((names) => names.length);
  if (!kept.length || new Set(kept.flat()).size > MOST_FIELDS) {
    sayScope(`one to ${MOST_FIELDS} fields`);
    return;
  }
  scope.panes = kept;
  store.write("panes", kept);
  const { capture } = scope;
  if (capture && capture.log) await loadCapture(capture, capture.every).catch((error) => sayScope(error.message));
  buildPanes();
}

// Cursors keep their time.
function showCapture(capture) {
  const before = scope.capture;
  scope.capture = capture;
  scope.cursors = scope.cursors.map((at) => (at === null || !before ? null : nearestIndex(capture.t, before.t[at])));
  refreshScope();
}

// What is drawn of the view. Where ticks are many, the lowest and the highest of each column; the
// capture keeps every tick.
function drawable(capture, names) {
  const { t } = capture, [from, to] = viewRange();
  const first = Math.max(0, nearestIndex(t, from) - 1), end = Math.min(t.length, nearestIndex(t, to) + 2);
  const size = Math.ceil((end - first) / COLUMNS);
  capture.perColumn = size > 2 ? size : 1;
  if (size <= 2) {
    return [t.subarray(first, end), ...names.map((name) => {
      const { factor } = shownUnit(name);
      return Array.from(capture.raw[name].subarray(first, end), (value) => (Number.isNaN(value) ? null : value * factor));
    })];
  }
  const times = [];
  for (let at = first; at < end; at += size) times.push(t[at], t[Math.min(at + (size >> 1), end - 1)]);
  return [times, ...names.map((name) => findExtremes(capture.raw[name].subarray(first, end), size, shownUnit(name).factor))];
}

// Two values for each `size` of many, in the order in which they came; null where all are unknown.
function findExtremes(values, size, factor) {
  const found = [];
  for (let begin = 0; begin < values.length; begin += size) {
    const end = Math.min(begin + size, values.length);
    let low = -1, high = -1;
    for (let at = begin; at < end; at++) {
      if (low < 0 ? !Number.isNaN(values[at]) : values[at] < values[low]) low = at;
      if (high < 0 ? !Number.isNaN(values[at]) : values[at] > values[high]) high = at;
    }
    if (low < 0) found.push(null, null);
    else found.push(values[Math.min(low, high)] * factor, values[Math.max(low, high)] * factor);
  }
  return found;
}

function refreshScope() {
  const { capture } = scope;
  for (const { chart, names } of scope.charts) {
    const there = capture && names.every((name) => capture.raw[name]);
    chart.setData(there ? drawable(capture, names) : [[], ...names.map(() => [])]);
  }
  byId("capturename").textContent = capture ? `${capture.log || "file"}, ticks ${capture.ticks[0]} to ${capture.ticks.at(-1)}` : "";
  showMarks();
  showMeasures();
  showSpectrum();
}

const spellEvent = ({ event, text }) => (event === "mark" ? String(text) : event);

// The remarks of what is shown; a click zooms in.
function showMarks() {
  const { capture } = scope, box = byId("marks");
  const marks = capture ? capture.events.filter(({ event, tick }) => ["mark", "tripped"].includes(event) && tick >= capture.ticks[0] && tick <= capture.ticks.at(-1)) : [];
  const key = JSON.stringify([capture?.log, capture?.t0, marks.map(({ tick }) => tick)]);
  if (box.dataset.key === key) return;
  box.dataset.key = key;
  box.replaceChildren(...marks.slice(-MOST_MARKS).map((mark) => {
    const t = capture.t[nearestIndex(capture.ticks, mark.tick)];
    const button = element("button", "plain", `${t.toFixed(2)} s: ${spellEvent(mark).slice(0, 60)}`);
    button.type = "button";
    button.addEventListener("click", () => setView(t - MARK_S, t + MARK_S));
    return button;
  }));
}

// --- cursors and measures --------------------------------------------------------------------------

function between() {
  const { capture, cursors: [a, b] } = scope;
  if (a !== null && b !== null && a !== b) return [Math.min(a, b), Math.max(a, b)];
  const [from, to] = viewRange();
  return [nearestIndex(capture.t, from), nearestIndex(capture.t, to)];
}

function tableRow(kind, cells) {
  const row = document.createElement("tr");
  cells.forEach((text, at) => row.append(element(at ? kind : "th", "", text)));
  return row;
}

function showMeasures() {
  const { capture, cursors: [a, b] } = scope;
  const body = byId("measures");
  if (!capture) return body.replaceChildren();
  const at = (values, index, factor = 1) => (index === null ? NaN : values[index] * factor);
  const tA = at(capture.t, a), tB = at(capture.t, b);
  const rows = [tableRow("td", ["time s", shownNumber(tA), shownNumber(tB), shownNumber(tB - tA), "", "", "",
    "", Number.isNaN(tB - tA) || tA === tB ? "" : `${shownNumber(1 / Math.abs(tB - tA))} Hz`])];
  const [first, last] = between();
  for (const name of wantedFields()) {
    const values = capture.raw[name];
    if (!values) continue;
    const { factor, unit } = shownUnit(name);
    const m = measure(values, first, last) ?? {};
    const numbers = [at(values, a), at(values, b), at(values, b) - at(values, a), m.low, m.high, m.peakToPeak, m.mean, m.rms];
    const row = tableRow("td", [`${name} ${unit}`, ...numbers.map((value) => shownNumber(value * factor))]);
    row.dataset.field = name;
    rows.push(row);
  }
  body.replaceChildren(...rows);
  for (const [id, index] of [["cura", a], ["curb", b]]) {
    if (document.activeElement !== byId(id)) byId(id).value = index === null ? "" : Number(capture.t[index].toPrecision(12));
  }
}

let spectrumChart = null;

function currentSpectrum() {
  const { capture } = scope, name = byId("sfield").value;
  if (!capture || !capture.raw[name] || capture.every !== 1) return null;
  const [first, last] = between();
  const samples = onGrid(capture.ticks.slice(first, last + 1), capture.raw[name].slice(first, last + 1));
  return spectrum(samples, scope.rateHz);
}

function showSpectrum() {
  const chosen = byId("sfield").value;
  byId("spectrum").hidden = chosen === "";
  if (chosen === "") return;
  const result = currentSpectrum(), { factor, unit } = shownUnit(chosen);
  byId("spectrumplot").hidden = !result;
  spectrumChart ??= new uPlot({
    width: byId("spectrum").clientWidth || 300, height: PANE_HEIGHT, legend: { show: false },
    scales: { x: { time: false, distr: 3 }, y: { distr: 3 } },
    series: [{}, { stroke: () => colour("--c0"), width: 1.5, points: { show: false } }],
    axes: [axis({ size: 26, values: (_, at) => at.map((v) => (v === null ? "" : `${v} Hz`)) }), axis({ size: 64, values: (_, at) => at.map((v) => (v === null ? "" : v.toExponential(0))) })],
  }, [[], []], byId("spectrumplot"));
  spectrumChart.setSize({ width: byId("spectrumplot").clientWidth, height: PANE_HEIGHT });
  if (!result) {
    byId("peak").textContent = "the spectrum needs a capture at every tick, without unknown values";
    spectrumChart.setData([[], []]);
    return;
  }
  const hz = Array.from(result.hz.subarray(1)), amplitude = Array.from(result.amplitude.subarray(1), (v) => Math.max(v * factor, 1e-12));
  spectrumChart.setData([hz, amplitude]);
  const top = amplitude.reduce((best, value, at) => (value > amplitude[best] ? at : best), 0);
  byId("peak").textContent = `largest line: ${shownNumber(amplitude[top])} ${unit} at ${shownNumber(hz[top])} Hz`;
}

// --- captures: kept, saved, opened again -----------------------------------------------------------

function download(name, content, kind) {
  const link = document.createElement("a");
  link.href = typeof content === "string" && content.startsWith("/") ? content : URL.createObjectURL(new Blob([content], { type: kind }));
  link.download = name;
  link.click();
  if (link.href.startsWith("blob:")) setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

const baseName = () => `${(scope.capture.log || "capture").replace(/\.(mcap|csv)$/, "")}-${scope.capture.ticks[0]}`;

function captureAsCsv() {
  const { raw } = scope.capture, names = Object.keys(raw);
  const lines = [names.join(",")];
  for (let at = 0; at < raw.tick.length; at++) lines.push(names.map((name) => raw[name][at]).join(","));
  return `${lines.join("\n")}\n`;
}

function captureAsPng() {
  const canvases = [...byId("panes").querySelectorAll("canvas")];
  const room = 22 * devicePixelRatio, page = document.createElement("canvas");
  page.width = Math.max(...canvases.map((one) => one.width));
  page.height = canvases.reduce((sum, one) => sum + one.height + room, room);
  const ctx = page.getContext("2d");
  ctx.fillStyle = colour("--bg");
  ctx.fillRect(0, 0, page.width, page.height);
  ctx.fillStyle = colour("--fg");
  ctx.font = `${13 * devicePixelRatio}px system-ui, sans-serif`;
  ctx.fillText(byId("capturename").textContent, 6, room * 0.7);
  let y = room;
  canvases.forEach((one, at) => {
    ctx.fillText(scope.panes[at].map((name) => `${name} ${shownUnit(name).unit}`).join(", "), 6, y + room * 0.7);
    ctx.drawImage(one, 0, y + room);
    y += one.height + room;
  });
  return new Promise((done) => page.toBlob(done, "image/png"));
}

function csvToCapture(text, name) {
  const [head, ...lines] = text.trim().split(/\r?\n/);
  const names = head.split(",");
  if (!names.includes("tick") || !names.includes("t_s")) throw new Error(`${name}: no columns tick and t_s: this is not a capture`);
  const rows = lines.map((line) => line.split(",").map(Number));
  const raw = Object.fromEntries(names.map((column, at) => [column, Float64Array.from(rows, (row) => row[at])]));
  return { log: "", first: raw.tick[0], last: raw.tick.at(-1), trigger: null, every: 1, events: [], raw, t0: 0, ticks: raw.tick, t: raw.t_s };
}

function listCaptures() {
  const kept = store.read("captures", []);
  byId("kept").replaceChildren(new Option(kept.length ? "captures" : "none is kept", ""), ...kept.map(({ name }, at) => new Option(name, at)));
}

function keepCapture() {
  const { capture } = scope;
  if (!capture?.log) return;
  const { log, first, last, trigger, events } = capture;
  const name = `${log.replace(/\.mcap$/, "")} tick ${trigger ?? first}`;
  store.write("captures", [...store.read("captures", []), { name, log, first: capture.ticks[0] ?? first, last: capture.ticks.at(-1) ?? last, trigger, panes: scope.panes,
    events: (events ?? []).filter(({ tick }) => tick >= capture.ticks[0] && tick <= capture.ticks.at(-1)) }]);
  listCaptures();
}

async function openKept(at) {
  const kept = store.read("captures", [])[at];
  if (!kept) return;
  setMode("still");
  Object.assign(scope, { view: null, cursors: [null, null], panes: kept.panes });
  buildPanes();
  await loadCapture(kept);
  sayScope("a kept capture");
}

async function openLog(log) {
  setMode("still");
  Object.assign(scope, { view: null, cursors: [null, null] });
  const events = await (await ask("/scope/events", { log })).json();
  await loadCapture({ log, first: 0, last: INT_MAX, trigger: null, events });
  sayScope(log);
}

// --- layouts ---------------------------------------------------------------------------------------

function listLayouts() {
  const layouts = store.read("layouts", {});
  byId("layout").replaceChildren(new Option("layouts", ""), ...Object.keys(layouts).map((name) => new Option(name, name)));
}

function saveLayout() {
  const name = byId("layoutname").value.trim();
  if (!name) return byId("layoutname").focus();
  store.write("layouts", { ...store.read("layouts", {}), [name]: scope.panes });
  listLayouts();
  byId("layout").value = name;
}

// --- wiring ----------------------------------------------------------------------------------------

function wireScope() {
  const remembered = store.read("trigger", {});
  const inputs = ["tfield", "tlevel", "tslope", "thyst", "tpre", "tpost", "tholdoff"];
  byId("tfield").append(...bench.fields.map(({ name }) => new Option(name, name)));
  byId("tfield").value = "error_m";
  byId("sfield").append(...bench.fields.map(({ name }) => new Option(name, name)));
  for (const id of inputs) if (remembered[id] !== undefined) byId(id).value = remembered[id];
  const showUnits = () => {
    for (const cell of document.querySelectorAll(".tunit")) cell.textContent = shownUnit(byId("tfield").value).unit;
  };
  byId("trigger").addEventListener("change", () => {
    store.write("trigger", Object.fromEntries(inputs.map((id) => [id, byId(id).value])));
    showUnits();
    arm();
  });
  byId("trigger").addEventListener("submit", (event) => event.preventDefault());
  showUnits();
  for (const button of document.querySelectorAll("[data-mode]")) button.addEventListener("click", () => (button.dataset.mode === "still" ? setStill() : setMode(button.dataset.mode)));
  const acts = {
    zoomin: () => moveView(0.5, 0), zoomout: () => moveView(2, 0), left: () => moveView(1, -0.25), right: () => moveView(1, 0.25),
    all: () => { scope.view = null; refreshScope(); }, addpane: () => changePanes((panes) => panes.push(["pressure_pa"])),
    savecsv: () => scope.capture && download(`${baseName()}.csv`, captureAsCsv(), "text/csv"),
    savepng: async () => scope.capture && download(`${baseName()}.png`, await captureAsPng(), "image/png"),
    savelog: saveCut, keep: keepCapture, savelayout: saveLayout,
  };
  for (const [id, act] of Object.entries(acts)) byId(id).addEventListener("click", act);
  for (const [id, which] of [["cura", 0], ["curb", 1]]) {
    byId(id).addEventListener("change", () => byId(id).value !== "" && scope.capture && placeCursor(which, nearestIndex(scope.capture.t, number(id))));
    byId(id).addEventListener("keydown", (event) => {
      const step = { ArrowUp: 1, ArrowDown: -1 }[event.key];
      if (!step || scope.cursors[which] === null) return;
      event.preventDefault();
      placeCursor(which, scope.cursors[which] + step * (event.shiftKey ? 10 : 1));
      byId(id).value = Number(scope.capture.t[scope.cursors[which]].toPrecision(12));
    });
  }
  byId("sfield").addEventListener("change", showSpectrum);
  byId("kept").addEventListener("change", () => openKept(byId("kept").value).catch((error) => sayScope(error.message)));
  byId("layout").addEventListener("change", () => {
    const panes = store.read("layouts", {})[byId("layout").value];
    if (panes) changePanes((all) => all.splice(0, all.length, ...panes));
  });
  byId("openfile").addEventListener("change", async () => {
    const [file] = byId("openfile").files;
    if (!file) return;
    try {
      const capture = csvToCapture(await file.text(), file.name);
      setMode("still");
      Object.assign(scope, { view: null, cursors: [null, null] });
      scope.panes = [Object.keys(capture.raw).filter((name) => name !== "tick" && name !== "t_s")].filter((names) => names.length);
      showCapture(capture);
      buildPanes();
      sayScope(file.name);
    } catch (error) {
      sayScope(error.message);
    }
  });
  listCaptures();
  listLayouts();
  sight.observe(byId("panes"));
  buildPanes();
  setMode("roll");
  repeat(SCOPE_MS, stepScope);
}

async function saveCut() {
  const { capture } = scope;
  if (!capture?.log) return;
  try {
    const query = { log: capture.log, first: capture.ticks[0], last: capture.ticks.at(-1) };
    const piece = await (await ask("/scope/cut", query)).arrayBuffer();
    download(`${baseName()}.mcap`, piece, "application/octet-stream");
  } catch (error) {
    sayScope(error.message);
  }
}
