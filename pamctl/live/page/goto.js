"use strict";
// Go to a position by dragging it in the displacement plot, or with the arrow keys and Enter.

const STEP_MM = 0.1;
const CANCELLED_PX = 60; // let go so far beside the plot, it does nothing

const dragged = { mm: null, isHeld: false, isOut: false }; // mm: null where nothing is chosen
const [{ chart: plot }] = charts;
const handle = element("div", "", "");
const grip = element("span", "", "");
Object.assign(handle, { id: "gotohandle", tabIndex: 0, hidden: true });
handle.setAttribute("role", "slider");
handle.setAttribute("aria-label", "go to a position: arrow keys, then Enter");
handle.setAttribute("aria-orientation", "vertical");
handle.append(grip);
plot.over.append(handle);

const strokeMm = () => bench.stroke_mm ?? [0, 1];
const inStroke = (mm) => Math.min(Math.max(Math.round(mm / STEP_MM) * STEP_MM, strokeMm()[0]), strokeMm()[1]);
const asked = () => series.reference.at(-1) ?? series.position.at(-1) ?? null;

// The daemon refuses a position while an experiment runs, or after a fault.
const mayGo = () => newestStatus?.run === "goto" || ["idle", "ready"].includes(newestStatus?.state);

function placeHandle() {
  handle.hidden = !dragged.isHeld && (byId("controls").hidden || !bench.stroke_mm || !mayGo());
  const mm = dragged.mm ?? asked() ?? number("target");
  const top = plot.valToPos(mm, "y"), height = plot.over.clientHeight;
  handle.style.top = `${Math.min(Math.max(Number.isFinite(top) ? top : height / 2, 0), height)}px`;
  handle.classList.toggle("moving", dragged.mm !== null);
  const told = dragged.isOut ? "cancel" : dragged.mm === null ? "\u2195 drag" : `${mm.toFixed(2)}${dragged.isHeld ? "" : " \u21b5"}`;
  if (grip.textContent !== told) grip.textContent = told;
  [["valuemin", strokeMm()[0]], ["valuemax", strokeMm()[1]], ["valuenow", mm.toFixed(2)], ["valuetext", `${mm.toFixed(2)} mm`]]
    .forEach(([name, value]) => handle.setAttribute(`aria-${name}`, value));
}

// All of the stroke comes into sight, and the position that was grabbed stays under the pointer.
function holdScale(mm, clientY) {
  const { top, height } = plot.over.getBoundingClientRect();
  const share = Math.min(Math.max(1 - (clientY - top) / height, 0.1), 0.9), [low, high] = strokeMm();
  const span = Math.max((mm - low) / share, (high - mm) / (1 - share), 1);
  heldScale = [mm - share * span, mm + (1 - share) * span];
}

function choose(mm) {
  dragged.mm = mm === null ? null : inStroke(mm);
  if (mm !== null) byId("target").value = Number(dragged.mm.toFixed(2));
  draw();
}

function letGo(isWanted) {
  const { mm, isOut } = dragged;
  Object.assign(dragged, { isHeld: false, isOut: false });
  heldScale = null;
  choose(null);
  if (isWanted && mm !== null && !isOut) order({ do: "goto", position_mm: mm });
}

grip.addEventListener("pointerdown", (event) => {
  if (event.button) return;
  event.preventDefault();
  event.stopPropagation();
  handle.focus({ preventScroll: true });
  grip.setPointerCapture(event.pointerId);
  const mm = inStroke(asked() ?? number("target"));
  holdScale(mm, event.clientY);
  dragged.isHeld = true;
  choose(mm);
});
grip.addEventListener("pointermove", (event) => {
  if (!dragged.isHeld) return;
  const { top, left, right, height } = plot.over.getBoundingClientRect();
  dragged.isOut = event.clientX < left - CANCELLED_PX || event.clientX > right + CANCELLED_PX;
  choose(heldScale[0] + (1 - (event.clientY - top) / height) * (heldScale[1] - heldScale[0]));
});
grip.addEventListener("pointerup", () => dragged.isHeld && letGo(true));
grip.addEventListener("pointercancel", () => dragged.isHeld && letGo(false));

handle.addEventListener("keydown", (event) => {
  const steps = { ArrowUp: STEP_MM, ArrowRight: STEP_MM, ArrowDown: -STEP_MM, ArrowLeft: -STEP_MM, PageUp: 10 * STEP_MM, PageDown: -10 * STEP_MM };
  const ends = { Home: strokeMm()[0], End: strokeMm()[1] };
  if (event.key === "Enter") letGo(true);
  else if (event.key in ends) choose(ends[event.key]);
  else if (event.key in steps) choose((dragged.mm ?? asked() ?? number("target")) + steps[event.key]);
  else return;
  event.preventDefault();
  event.stopPropagation();
});
handle.addEventListener("blur", () => dragged.isHeld || letGo(false));
document.addEventListener("drawn", placeHandle);
setInterval(placeHandle, 500);
