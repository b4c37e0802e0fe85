"use strict";
// The page of `pamctl watch --web`. Metres and pascals come in; millimetres and kilopascals are shown.

const token = location.hash.slice(1);
const PHASES = ["homing", "approach", "track", "rest", "open loop", "stopping"];
const LONGEST_S = 60;
const SHORTEST_S = 2;
const HEIGHT = 180;
const GAP_S = 0.5; // no line is drawn through a longer time without values
const NEWS_MS = 100;
const ASIDE = 5; // so many times less often looks a tab that nobody works in,
const HIDDEN = 10; // or that nobody sees: only its title tells the state
const SILENT_MS = 2000;
const CONFIRMED_MS = 300;
const YIELD_MS = 2 * CONFIRMED_MS;
const byId = (id) => document.getElementById(id);
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const scaled = (value, factor) => (value === null ? null : value * factor);

// --- plots -----------------------------------------------------------------------------------

const series = { t: [], position: [], reference: [], error: [], pressure: [], command: [] };
const PLOTS = [
  { title: "displacement", unit: "mm", lines: [["reference", "--c1", "k1"], ["position", "--c0", "k0"]] },
  { title: "error", unit: "\u00b5m", lines: [["error", "--c0", "k0"]] },
  { title: "pressure", unit: "kPa", lines: [["pressure", "--c2", "k2"]] },
  { title: "valve command", unit: "V", lines: [["command", "--c3", "k3"]] },
];
let shownS = 30;

// Texts are set when they change only: a screen reader says each change of the state once.
function put(id, text) {
  const cell = byId(id);
  if (cell.textContent !== text) cell.textContent = text;
}

function putItems(id, about, makeItem) {
  const list = byId(id), key = JSON.stringify(about);
  if (list.dataset.key === key) return;
  list.dataset.key = key;
  list.replaceChildren(...[...about].reverse().map(makeItem));
}

// Drawing is most of the work: what is scrolled out of sight is not drawn.
const inSight = new WeakSet();
const sight = new IntersectionObserver((changes) => {
  for (const { target, isIntersecting } of changes) {
    if (isIntersecting) inSight.add(target); else inSight.delete(target);
    if (isIntersecting) target.dispatchEvent(new Event("insight"));
  }
}, { rootMargin: "200px" });

// While an order is on its way, no tab asks or draws: the PC and the connections are the order's.
const tabs = new BroadcastChannel("pamctl.orders");
let yieldsUntilMs = 0;
const yieldToOrder = (isPending) => { yieldsUntilMs = isPending ? performance.now() + YIELD_MS : 0; };
tabs.onmessage = ({ data }) => yieldToOrder(data);

function announceOrder(isPending) {
  yieldToOrder(isPending);
  tabs.postMessage(isPending);
}

// Runs rounds for ever. A busy PC sets a slower pace.
async function repeat(everyMs, round) {
  const beganMs = performance.now();
  if (beganMs > yieldsUntilMs) await round();
  const tookMs = performance.now() - beganMs, pace = document.hidden ? HIDDEN : document.hasFocus() ? 1 : ASIDE;
  setTimeout(repeat, Math.max(pace * everyMs - tookMs, 2 * tookMs, 10), everyMs, round);
}

function element(kind, className, text) {
  const made = document.createElement(kind);
  made.className = className;
  made.textContent = text;
  return made;
}

function xRange() {
  if (!series.t.length) return [0, 1];
  const end = series.t[series.t.length - 1];
  return [Math.max(end - shownS, Math.min(series.t[0], end - SHORTEST_S)), end];
}

let heldScale = null; // of the displacement, while a position is dragged

function yRange(chart, low, high) {
  if (heldScale && chart === charts[0]?.chart) return heldScale;
  if (low === null) return [0, 1];
  const room = Math.max((high - low) * 0.08, Math.abs(high) * 1e-6, 1e-3);
  return [low - room, high + room];
}

function axis(options) {
  return { stroke: () => colour("--dim"), font: "12px system-ui, sans-serif",
    grid: { stroke: () => colour("--rule"), width: 1 }, ticks: { show: false }, ...options };
}

// The numbers stand beside it as text.
function describePlot(chart, title) {
  chart.ctx.canvas.setAttribute("role", "img");
  chart.ctx.canvas.setAttribute("aria-label", `plot of ${title}`);
}

function madePlot(plot) {
  const box = element("div", "plot", "");
  const title = element("div", "ptitle", plot.title);
  title.append(element("span", "unit", plot.unit));
  if (plot.lines.length > 1) for (const [name, , key] of plot.lines) title.append(element("span", `key ${key}`, name));
  box.append(title);
  byId("plots").append(box);
  const chart = new uPlot({
    width: box.clientWidth, height: HEIGHT, legend: { show: false }, pxAlign: 0,
    cursor: { sync: { key: "all" }, drag: { x: false, y: false }, y: false },
    scales: { x: { time: false, range: xRange }, y: { range: yRange } },
    series: [{}, ...plot.lines.map(([name, line]) => ({ label: name, stroke: () => colour(line), width: 1.5, points: { show: false } }))],
    axes: [axis({ size: 26, values: (_, at) => at.map((v) => `${v} s`) }), axis({ size: 56 })],
  }, [[], ...plot.lines.map(() => [])], box);
  new ResizeObserver(() => chart.setSize({ width: box.clientWidth, height: HEIGHT })).observe(box);
  describePlot(chart, plot.title);
  sight.observe(box);
  box.addEventListener("insight", draw);
  return { box, chart, names: plot.lines.map(([name]) => name) };
}

const charts = PLOTS.map(madePlot);

function draw() {
  if (document.hidden) return;
  for (const { box, chart, names } of charts) if (inSight.has(box)) chart.setData([series.t, ...names.map((name) => series[name])]);
  document.dispatchEvent(new Event("drawn"));
}

document.addEventListener("visibilitychange", draw);

function forgetAll() {
  for (const values of Object.values(series)) values.length = 0;
}

function breakLines(t) {
  for (const [name, values] of Object.entries(series)) values.push(name === "t" ? t : null);
}

function keep(fields, ticks) {
  const at = Object.fromEntries(fields.map((name, index) => [name, index]));
  for (const tick of ticks) {
    const t = tick[at.t_s], x = tick[at.position_m], ref = tick[at.reference_m];
    const before = series.t[series.t.length - 1];
    if (t < before) forgetAll(); // another session
    else if (t - before > GAP_S) breakLines((t + before) / 2);
    series.t.push(t);
    series.position.push(scaled(x, 1e3));
    series.reference.push(scaled(ref, 1e3));
    series.error.push(x === null || ref === null ? null : (x - ref) * 1e6);
    series.pressure.push(scaled(tick[at.pressure_pa], 1e-3));
    series.command.push(tick[at.valve_v]);
  }
  const end = series.t[series.t.length - 1];
  let old = 0;
  while (series.t[old] < end - LONGEST_S) old++;
  if (old) for (const values of Object.values(series)) values.splice(0, old);
}

// --- figures and events ----------------------------------------------------------------------

function figure(id, value, digits, unit, signed) {
  const known = value !== null && value !== undefined;
  const text = known ? value.toFixed(digits).replace(/^-/, "\u2212") : "-";
  put(id, known ? `${signed && value >= 0 ? "+" : ""}${text} ${unit}` : "-");
}

function showNewest(fields, ticks, isLive) {
  if (!ticks.length) {
    if (!isLive) for (const cell of document.querySelectorAll("#figures dd")) cell.textContent = "-";
    return;
  }
  const last = series.t.length - 1;
  figure("reference", series.reference[last], 3, "mm");
  figure("position", series.position[last], 3, "mm");
  figure("error", series.error[last], 1, "\u00b5m", true);
  figure("pressure", series.pressure[last], 1, "kPa");
  figure("command", series.command[last], 3, "V", true);
  put("phase", PHASES[ticks[ticks.length - 1][fields.indexOf("phase")]] ?? "-");
}

function showStatus(status, problem) {
  newestStatus = status;
  byId("ack").hidden = byId("controls").hidden || status?.state !== "fault";
  const state = status ? status.state : "away";
  put("state", state);
  byId("state").dataset.state = state;
  put("what", status ? status.fault || status.run || "" : problem);
  put("where", status ? `${status.backend} ${status.device}, ${spellController(status.names)}` : "");
  document.title = `${state} \u00b7 pamctl`;
  if (!status) return;
  figure("late", scaled(status.worst_late_s, 1e6), 1, "\u00b5s");
  put("missed", String(status.missed_ticks ?? "-"));
  put("log", status.log ? `log: ${status.log}` : "");
  put("monitor", status.monitor ? status.monitor.sentence : "");
  putItems("events", status.events, eventItem);
}

function spellController({ controller, controller_changes: changes }) {
  return changes ? `${controller}*, ${changes}` : controller;
}

function eventItem(event) {
  const { event: what, time_s: at, log, ...details } = event;
  const item = document.createElement("li");
  const when = document.createElement("time");
  when.textContent = new Date(at * 1e3).toLocaleTimeString();
  const told = Object.entries(details).filter(([, value]) => value !== "").map(([name, value]) => `${name} ${value}`);
  item.append(when, [what, told.join(", ")].filter(Boolean).join(": "));
  return item;
}

// --- what is new -----------------------------------------------------------------------------

let newestStatus = null;
let server = "", look = 0, heardMs = performance.now();
const pending = new Set();

// Each question is answered at once, and ends. A connection that stayed open would be missing to
// orders: a browser has six for all tabs.
async function askForNews() {
  const answer = await fetch(`/news?server=${server}&after=${look}`, { priority: "low", signal: AbortSignal.timeout(SILENT_MS) });
  if (!answer.ok) throw new Error(answer.statusText);
  const news = await answer.json();
  if (news.server !== server) {
    forgetAll(); // all of the last minute follows
    showMode(news.control);
  }
  ({ server, look } = news);
  heardMs = performance.now();
  showOutcomes(news.orders);
  keep(news.fields, news.ticks);
  const { status } = news;
  if (news.age_s * 1e3 > SILENT_MS) showStatus(null, "the daemon does not answer");
  else if (look) showStatus(status, news.problem);
  showNewest(news.fields, news.ticks, status !== null && status.state !== "idle" && status.state !== "fault");
  if (news.ticks.length) draw();
}

async function followNews() {
  try {
    await askForNews();
  } catch {
    if (performance.now() - heardMs > SILENT_MS) showStatus(null, "pamctl watch does not answer");
  }
}

function showMode(control) {
  const may = control && token !== "";
  byId("estop").hidden = !may;
  for (const part of ["controls", "gainbox", "experimentbox", "markform"]) byId(part).hidden = !may;
  byId("mode").textContent = may ? "" : control
    ? "read-only: open the page by its whole address, with the token behind #"
    : "read-only; to stop, in a terminal: pamctl estop";
}

byId("window").addEventListener("change", (event) => {
  shownS = Number(event.target.value);
  draw();
});

// --- orders ----------------------------------------------------------------------------------

function say(text, kind) {
  const notice = byId("notice");
  notice.hidden = text === "";
  notice.textContent = text;
  notice.className = kind ?? "";
}

function send(what) {
  return fetch("/do", {
    method: "POST", body: JSON.stringify(what), priority: "high", signal: AbortSignal.timeout(SILENT_MS),
    headers: { "Content-Type": "application/json", Authorization: `Bearer ${token}` },
  });
}

// Returns whether the daemon has taken it.
async function order(what) {
  const beganMs = performance.now();
  const sayNotSent = () => say(`NOT SENT: ${what.do} is not confirmed; in a terminal: pamctl ${what.do}`, "notsent");
  // One turn more: where the page itself was busy, the answer may lie there already.
  let late = setTimeout(() => { late = setTimeout(sayNotSent, 0); }, CONFIRMED_MS);
  announceOrder(true);
  try {
    const answer = await send(what);
    const told = await answer.json();
    clearTimeout(late);
    if (answer.status === 202) pending.add(told.order);
    const tookMs = performance.now() - beganMs;
    if (!answer.ok) say(`NOT DONE: ${what.do}: ${told.error}`, what.do === "estop" ? "notsent" : "");
    else say(tookMs > CONFIRMED_MS ? `${what.do}: confirmed after ${(tookMs / 1e3).toFixed(1)} s` : "");
    return answer.ok;
  } catch {
    clearTimeout(late);
    sayNotSent();
    if (what.do === "estop") setTimeout(() => order(what), CONFIRMED_MS); // until it gets through
    return false;
  } finally {
    announceOrder(false);
  }
}

function showOutcomes(outcomes) {
  for (const { order: number, do: what, error } of outcomes) {
    if (!pending.delete(number) || !error) continue;
    say(`NOT DONE: ${what}: ${error}`);
    if (what === "set") followController.known = null; // show the gains that hold
  }
}

byId("estop").addEventListener("click", () => order({ do: "estop" }));
byId("stop").addEventListener("click", () => order({ do: "stop" }));
byId("controls").addEventListener("submit", (event) => {
  event.preventDefault();
  order({ do: "goto", position_mm: Number(byId("target").value) });
});

repeat(NEWS_MS, followNews);
