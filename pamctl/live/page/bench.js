"use strict";
// Gains, experiments, marks, keys, and the runs of the daemon's folder.

const bench = { fields: [], phases: [], gains: [], experiments: [], rate_hz: null, stroke_mm: null };

async function loadBench() {
  const answer = await fetch("/bench", { signal: AbortSignal.timeout(20000) });
  if (!answer.ok) throw new Error(answer.statusText);
  Object.assign(bench, await answer.json());
  scope.rateHz = bench.rate_hz ?? scope.rateHz;
}

// --- gains -----------------------------------------------------------------------------------------

// A slider spans a decade to each side of the value, within the bounds of the schema.
function sliderSpan({ value, low, above, high, below }) {
  const bottom = low ?? above ?? -Infinity, top = high ?? below ?? Infinity;
  if (value === 0) return [Math.max(bottom, -1), Math.min(top, 1)];
  const size = Math.abs(value);
  return value > 0 ? [Math.max(bottom, size / 10), Math.min(top, size * 10)] : [Math.max(bottom, -size * 10), Math.min(top, -size / 10)];
}

function spellBounds({ low, above, high, below }) {
  const from = low !== undefined ? `at least ${low}` : above !== undefined ? `above ${above}` : "";
  const to = high !== undefined ? `at most ${high}` : below !== undefined ? `below ${below}` : "";
  return [from, to].filter(Boolean).join(", ");
}

const isWithin = (value, { low, above, high, below }) => Number.isFinite(value) && !(value < low || value <= above || value > high || value >= below);

// The keyboard stays where it was.
function buildGains() {
  const { type, parentElement: row } = document.activeElement;
  byId("gains").replaceChildren(...bench.gains.map(gainRow));
  document.querySelector(`[data-gain="${row?.dataset.gain}"] input[type=${type}]`)?.focus();
}

function gainRow(gain) {
  const row = element("div", "gain", "");
  row.dataset.gain = gain.name;
  const label = element("label", "", gain.name);
  label.title = gain.about;
  label.htmlFor = `gain-${gain.name}`;
  const field = document.createElement("input");
  Object.assign(field, { type: "number", step: "any", id: `gain-${gain.name}`, value: gain.value });
  const slider = document.createElement("input");
  const [from, to] = sliderSpan(gain);
  const toSlider = (value) => (from > 0 ? 1000 * Math.log(value / from) / Math.log(to / from) : 1000 * (value - from) / (to - from));
  const fromSlider = (at) => (from > 0 ? from * (to / from) ** (at / 1000) : from + (to - from) * at / 1000);
  Object.assign(slider, { type: "range", min: 0, max: 1000, step: 1, value: toSlider(gain.value) });
  slider.setAttribute("aria-label", `${gain.name}, slider`);
  const told = element("small", "", [spellBounds(gain), gain.runs ? "" : "between runs only"].filter(Boolean).join("; "));
  slider.addEventListener("input", () => { field.value = Number(fromSlider(Number(slider.value)).toPrecision(4)); });
  slider.addEventListener("change", () => setGain(gain, Number(field.value)));
  field.addEventListener("change", () => setGain(gain, field.value === "" ? NaN : Number(field.value)));
  row.append(label, field, slider, told);
  return row;
}

async function setGain({ name }, value) {
  const gain = bench.gains.find((one) => one.name === name);
  if (!isWithin(value, gain)) {
    say(`NOT SENT: ${gain.name} must be ${spellBounds(gain) || "a number"}`);
    return buildGains();
  }
  if (value === gain.value) return;
  if (await order({ do: "set", gains: { [gain.name]: value }, ramp_s: number("ramp"), operator: who() })) gain.value = value;
  buildGains();
}

// Who changed which gain when; the daemon keeps it for all clients, and takes back what any of them did.
function showGainChanges() {
  const changes = newestStatus?.gain_changes ?? [], last = changes.find(({ undoable }) => undoable);
  byId("undo").disabled = !last;
  put("undo", last ? `Undo: ${last.what}` : "Undo");
  putItems("gainchanges", changes, ({ time_s: at, by, what }) => {
    const item = document.createElement("li"), when = element("time", "", new Date(at * 1e3).toLocaleTimeString());
    item.append(when, `${by || "another client"}: ${what}`);
    return item;
  });
}

const who = () => byId("operator").value.trim() || "page";

// --- experiments -----------------------------------------------------------------------------------

function chooseExperiment() {
  const chosen = bench.experiments.find(({ name }) => name === byId("experiment").value);
  byId("numbers").replaceChildren(...Object.entries(chosen?.numbers ?? {}).map(([name, value]) => {
    const label = element("label", "", name);
    const field = document.createElement("input");
    Object.assign(field, { type: "number", step: "any", value });
    field.dataset.number = name;
    label.append(field);
    return label;
  }));
}

function startExperiment() {
  const chosen = bench.experiments.find(({ name }) => name === byId("experiment").value);
  const numbers = {};
  for (const field of byId("numbers").querySelectorAll("input")) {
    const value = Number(field.value), name = field.dataset.number;
    if (field.value === "" || !Number.isFinite(value)) return say(`NOT SENT: ${name} must be a number`);
    if (value !== chosen.numbers[name]) numbers[name] = value;
  }
  order({ do: "start", experiment: chosen.name, numbers, operator: byId("operator").value.trim() });
}

function mark() {
  const text = byId("marktext").value.trim();
  if (!text) return byId("marktext").focus();
  order({ do: "mark", text: byId("operator").value.trim() ? `${who()}: ${text}` : text });
  byId("marktext").value = "";
  byId("marktext").blur();
}

// --- runs ------------------------------------------------------------------------------------------

let overlayCharts = [];

async function loadRuns() {
  const answer = await fetch("/runs", { signal: AbortSignal.timeout(60000) });
  const runs = answer.ok ? await answer.json() : [];
  const chosen = new Set([...document.querySelectorAll("[data-run]:checked")].map((box) => box.dataset.run));
  byId("runs").replaceChildren(...runs.map((run) => runRow(run, chosen)));
}

function runRow(run, chosen) {
  const row = document.createElement("tr");
  const box = document.createElement("input");
  Object.assign(box, { type: "checkbox", checked: chosen.has(run.path) });
  box.dataset.run = run.path;
  box.setAttribute("aria-label", `overlay ${run.path}`);
  const first = document.createElement("td");
  first.append(box);
  const open = element("button", "plain", new Date(run.when_s * 1e3).toLocaleString());
  open.type = "button";
  open.title = `open ${run.path} in the scope`;
  open.addEventListener("click", () => openLog(run.path).then(() => byId("scope").scrollIntoView()).catch((error) => say(error.message)));
  const name = document.createElement("th");
  name.append(open);
  const micrometres = (value) => (value === null ? "-" : value.toFixed(1));
  row.append(first, name, ...[run.controller, run.experiment, run.ending, run.duration_s.toFixed(1), micrometres(run.max_um),
    micrometres(run.rms_um), micrometres(run.steady_um), run.note].map((text) => element("td", "", text)));
  return row;
}

// The time of a run that becomes zero on the common axis.
async function alignRun(log, columns, how) {
  if (how === "phase") {
    const at = columns.phase.indexOf(bench.phases.indexOf("track"));
    if (at < 0) throw new Error(`${log}: it has no phase "track": align by the beginning or the trigger`);
    return columns.t_s[at];
  }
  if (how === "begin") return columns.t_s[0];
  const field = byId("tfield").value, { factor } = shownUnit(field);
  const found = await (await ask("/scope/trigger", { log, field, level: number("tlevel") / factor,
    slope: byId("tslope").value, hysteresis: number("thyst") / factor })).json();
  if (found.tick === null) throw new Error(`${log}: the trigger does not fire in it`);
  return found.t_s;
}

async function overlayRuns() {
  const logs = [...document.querySelectorAll("[data-run]:checked")].map((box) => box.dataset.run);
  if (logs.length < 2) return say("choose two runs or more to lay over each other");
  try {
    const tables = [];
    for (const log of logs) {
      const columns = await fetchColumns(log, 0, INT_MAX, ["t_s", "phase", "position_m", "reference_m"]);
      const zero = await alignRun(log, columns, byId("align").value);
      tables.push({ log, zero, columns, t: Array.from(columns.t_s, (t) => Math.round((t - zero) * 1e6) / 1e6) });
    }
    drawOverlay(tables);
    say("");
  } catch (error) {
    say(error.message);
  }
}

function drawOverlay(tables) {
  for (const chart of overlayCharts) chart.destroy();
  byId("overlay").replaceChildren();
  const kinds = [
    ["displacement", "mm", ({ columns }) => Array.from(columns.position_m, (x) => x * 1e3)],
    ["error", "\u00b5m", ({ columns }) => Array.from(columns.position_m, (x, at) => (x - columns.reference_m[at]) * 1e6)],
  ];
  overlayCharts = kinds.map(([title, unit, values]) => {
    const box = element("div", "plot", ""), head = element("div", "ptitle", title);
    head.append(element("span", "unit", unit), ...tables.map(({ log }, k) => element("span", `key k${k % 4}`, log)));
    box.append(head);
    byId("overlay").append(box);
    const data = uPlot.join(tables.map((table) => [table.t, values(table).map((v) => (Number.isNaN(v) ? null : v))]));
    const chart = new uPlot({
      width: box.clientWidth || 300, height: PANE_HEIGHT, legend: { show: false }, cursor: { sync: { key: "overlay" }, drag: { x: true, y: false }, y: false },
      scales: { x: { time: false } },
      series: [{}, ...tables.map(({ log }, k) => ({ label: log, stroke: () => colour(COLOURS[k % 4]), width: 1.5, points: { show: false }, spanGaps: true }))],
      axes: [axis({ size: 26, values: (_, at) => at.map((v) => `${v} s`) }), axis({ size: 64 })],
    }, data, box);
    new ResizeObserver(() => chart.setSize({ width: box.clientWidth, height: PANE_HEIGHT })).observe(box);
    return chart;
  });
}

// --- keys ------------------------------------------------------------------------------------------

function onKey(event) {
  if (event.key === "Escape" && !byId("estop").hidden) {
    event.preventDefault();
    if (!event.repeat) order({ do: "estop" });
    return;
  }
  if (event.ctrlKey || event.metaKey || event.altKey || /^(INPUT|SELECT|TEXTAREA|BUTTON)$/.test(event.target.tagName)) return;
  const acts = {
    m: () => !byId("markform").hidden && byId("marktext").focus(),
    " ": () => (scope.mode === "still" ? setMode("roll") : setStill()),
    s: () => setMode("single"), n: () => setMode("normal"), r: () => setMode("roll"),
    "+": () => moveView(0.5, 0), "-": () => moveView(2, 0), ArrowLeft: () => moveView(1, -0.25), ArrowRight: () => moveView(1, 0.25),
  };
  if (!acts[event.key]) return;
  event.preventDefault();
  acts[event.key]();
}

function wireBench() {
  byId("experiment").append(...bench.experiments.map(({ name }) => new Option(name, name)));
  byId("experiment").value = "tracking-2";
  byId("experiment").addEventListener("change", chooseExperiment);
  byId("start").addEventListener("click", startExperiment);
  byId("undo").addEventListener("click", () => order({ do: "undo", ramp_s: number("ramp"), operator: who() }));
  byId("ack").addEventListener("click", () => order({ do: "ack" }));
  byId("markform").addEventListener("submit", (event) => { event.preventDefault(); mark(); });
  byId("operator").value = store.read("operator", "");
  byId("operator").addEventListener("change", () => store.write("operator", byId("operator").value.trim()));
  byId("loadruns").addEventListener("click", () => loadRuns().catch((error) => say(error.message)));
  byId("lay").addEventListener("click", overlayRuns);
  document.addEventListener("keydown", onKey);
  chooseExperiment();
}

// The gains of another client, or of a daemon that came back.
async function followController() {
  showGainChanges();
  const now = JSON.stringify(newestStatus?.controller ?? null);
  if (now !== followController.known && newestStatus) {
    followController.known = now;
    await loadBench();
    if (!byId("gains").contains(document.activeElement)) buildGains();
    [byId("target").min, byId("target").max] = bench.stroke_mm ?? ["", ""];
  }
}

async function openBench() {
  try {
    await loadBench();
    wireBench();
    wireScope();
    setInterval(() => followController().catch(() => {}), 500);
    await loadRuns();
  } catch (error) {
    if (bench.fields.length) throw error;
    setTimeout(openBench, 1000);
  }
}
openBench();
