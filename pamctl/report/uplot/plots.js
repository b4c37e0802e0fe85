// Replaces the drawn plots of a page by uPlot's, which zoom and have a cursor.
"use strict";
(() => {
  const { plots, arrays } = JSON.parse(document.getElementById("plots").textContent);
  const decoded = new Map();
  const array = (number) => {
    if (!decoded.has(number)) {
      const [kind, text] = arrays[number];
      const buffer = Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
      const values = kind === "f8" ? new Float64Array(buffer) : new Float32Array(buffer);
      // uPlot breaks a line at null, not at NaN.
      decoded.set(number, kind === "f8" ? values : Array.from(values, (v) => (Number.isFinite(v) ? v : null)));
    }
    return decoded.get(number);
  };

  // The style sheet knows the colours, for light, dark and print.
  const probe = document.body.appendChild(document.createElement("i"));
  const colour = (css) => {
    probe.className = css;
    return getComputedStyle(probe).color;
  };
  const faded = (css, share) => colour(css).replace("rgb(", "rgba(").replace(")", `, ${share})`);
  const shade = (name) => getComputedStyle(document.documentElement).getPropertyValue(name);
  const hueOf = (css) => css.split(" ").find((word) => /^c[\dm]$/.test(word));

  const format = (value, span) => {
    if (value == null) return "-";
    const digits = Math.min(9, Math.max(0, 3 - Math.floor(Math.log10(span || 1))));
    return value.toFixed(digits).replace("-", "\u2212");
  };

  // uPlot gives null for what has no room.
  const writeTicks = (u, values) => values.map((v) => (v == null ? "" : String(+v.toPrecision(12)).replace("-", "\u2212")));

  // Every mark is a table of x and its y; uPlot wants one x for all.
  const tabulate = (marks) => {
    const tables = marks.map((mark) => {
      const x = array(mark.x), ys = mark.y.map(array);
      if (mark.kind !== "band" || x.length > 2) return [x, ...ys];
      // A level band has two points: between them it needs some to be seen when zoomed.
      const over = array((marks.find((m) => m.kind !== "band") ?? mark).x).filter((v) => v >= x[0] && v <= x[1]);
      return [over, ...ys.map((y) => Array.from(over, () => y[0]))];
    });
    const same = marks.every((mark) => mark.x === marks[0].x);
    return same ? [tables[0][0], ...tables.flatMap((t) => t.slice(1))] : uPlot.join(tables);
  };

  const describeSeries = (mark) => {
    const hue = hueOf(mark.css);
    if (mark.kind === "band") return mark.y.map((_, side) => ({ stroke: null, points: { show: false }, band: side ? hue : "" }));
    const points = mark.kind === "points";
    return [{
      stroke: () => colour(hue),
      width: / thick/.test(mark.css) ? 3 : 1.3,
      paths: points ? () => null : mark.kind === "step" ? uPlot.paths.stepped({ align: 1 }) : undefined,
      points: points ? { show: true, size: / few/.test(mark.css) ? 7 : 4, stroke: () => colour(hue), fill: () => colour(hue) } : { show: false },
      hue,
      mark,
    }];
  };

  const drawLines = (plot) => (chart) => {
    const { ctx, bbox } = chart, ratio = devicePixelRatio;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    ctx.setLineDash([6 * ratio, 4 * ratio]);
    ctx.lineWidth = 1.2 * ratio;
    ctx.textBaseline = "alphabetic";
    ctx.font = `${12 * ratio}px system-ui, sans-serif`;
    let above = -Infinity, row = 0;
    const write = (text, x, y) => {
      ctx.save();
      ctx.setLineDash([]);
      ctx.lineWidth = 3 * ratio;
      ctx.strokeStyle = shade("--plot");
      ctx.strokeText(text, x, y);
      ctx.fillStyle = shade("--fg");
      ctx.fillText(text, x, y);
      ctx.restore();
    };
    for (const line of plot.lines) {
      const upright = line.axis === "x";
      const at = chart.valToPos(line.value, line.axis, true);
      ctx.strokeStyle = colour(line.css);
      ctx.beginPath();
      if (upright) { ctx.moveTo(at, bbox.top); ctx.lineTo(at, bbox.top + bbox.height); }
      else { ctx.moveTo(bbox.left, at); ctx.lineTo(bbox.left + bbox.width, at); }
      ctx.stroke();
      if (!line.label) continue;
      if (upright) {
        const width = ctx.measureText(line.label).width + 8 * ratio;
        const isLast = at + width > bbox.left + bbox.width;
        row = (isLast ? at - width : at) < above ? (row + 1) % 4 : 0;
        above = isLast ? at : at + width;
        ctx.textAlign = isLast ? "right" : "left";
        write(line.label, at + (isLast ? -4 : 4) * ratio, bbox.top + (12 + 13 * row) * ratio);
      } else {
        ctx.textAlign = "right";
        write(line.label, bbox.left + bbox.width - 4 * ratio, at - 4 * ratio);
      }
    }
    ctx.restore();
  };

  const groups = new Map(); // charts with the same x axis zoom together
  const zoom = (key, min, max) => {
    for (const { chart, plot } of groups.get(key)) {
      chart.isZoomed = max - min < 0.999 * (plot.x.high - plot.x.low);
      chart.setScale("x", { min, max });
    }
  };

  // The title says where the cursor is, the legend what each line is there.
  const makeReadout = (holder, plot, series) => {
    const append = (parent) => parent.appendChild(Object.assign(document.createElement("span"), { className: "value" }));
    const where = append(holder.querySelector(".ptitle"));
    const entries = [...holder.querySelectorAll(".legend li")].map(append);
    const labelled = plot.marks.filter((mark) => mark.label);
    return (chart) => {
      const { min, max } = chart.scales.x, nearest = chart.cursor.idx;
      const away = nearest == null ? 0 : Math.abs(chart.valToPos(chart.data[0][nearest], "x") - chart.cursor.left);
      const idx = away > 8 ? null : nearest; // another run may be longer
      const read = (k) => `${format(chart.data[k + 1][idx], plot.y.high - plot.y.low)} ${plot.y.unit}`;
      const said = idx == null ? [] : [`${format(chart.data[0][idx], max - min)} ${plot.x.unit}`];
      for (const entry of entries) entry.textContent = "";
      series.forEach((one, k) => {
        if (idx == null || !one.hue || chart.data[k + 1][idx] == null) return;
        const entry = entries[labelled.indexOf(one.mark)];
        if (entry) entry.textContent = read(k);
        else said.push(read(k));
      });
      where.textContent = said.join(": ");
    };
  };

  const build = (holder) => {
    const plot = plots[Number(holder.dataset.plot)];
    const frame = holder.querySelector(".frame");
    const series = plot.marks.flatMap(describeSeries);
    // A band lies between the lower series and the one after it.
    const bands = series.flatMap(({ band }, k) => (band ? [{ series: [k + 1, k], fill: () => faded(band, 0.22) }] : []));
    const key = JSON.stringify([plot.x.label, plot.x.low, plot.x.high]);
    const axis = { stroke: () => shade("--dim"), grid: { stroke: () => shade("--rule"), width: 1 }, ticks: { show: false }, font: "12px system-ui, sans-serif" };
    const distr = (given) => (given.log ? 3 : 1);
    // Zoomed, the y axis shows what is there; else it is the page's.
    const rangeY = (u, low, high) => {
      if (!u.isZoomed || low == null || low >= high) return [plot.y.low, plot.y.high];
      return plot.y.log ? [low, high] : uPlot.rangeNum(low, high, 0.08, false);
    };
    const nameX = [plot.x.label, plot.x.unit].filter(Boolean).join(", ");
    const height = plot.height + (plot.x.named ? 60 : 42);
    frame.textContent = "";
    const beside = Math.max(56, parseFloat(getComputedStyle(frame).paddingLeft));
    frame.style.padding = 0;
    const chart = new uPlot({
      width: frame.clientWidth,
      height,
      legend: { show: false },
      cursor: { y: false, sync: { key, scales: ["x", null] }, drag: { x: true, y: false, setScale: false }, bind: { dblclick: () => () => zoom(key, plot.x.low, plot.x.high) } },
      scales: {
        x: { time: false, distr: distr(plot.x), range: (u, min, max) => [min, max] },
        y: { distr: distr(plot.y), range: rangeY },
      },
      axes: [
        { ...axis, size: 26, values: writeTicks, label: plot.x.named ? nameX : undefined, labelSize: 18, labelFont: axis.font },
        { ...axis, size: beside, values: writeTicks },
      ],
      series: [{}, ...series],
      bands,
      hooks: {
        draw: [drawLines(plot)],
        setCursor: [makeReadout(holder, plot, series)],
        setSelect: [(u) => {
          const { left, width } = u.select;
          if (width > 4) zoom(key, u.posToVal(left, "x"), u.posToVal(left + width, "x"));
          u.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
        }],
      },
    }, tabulate(plot.marks), frame);
    chart.setScale("x", { min: plot.x.low, max: plot.x.high });
    chart.root.setAttribute("role", "img");
    chart.root.setAttribute("aria-label", `${plot.title} over ${plot.x.label}`);
    new ResizeObserver(() => chart.setSize({ width: frame.clientWidth, height })).observe(frame);
    if (!groups.has(key)) groups.set(key, []);
    groups.get(key).push({ chart, plot });
    return { key, chart, plot };
  };

  // A phone and a keyboard have no mouse to drag: buttons over each figure.
  const addTools = (figure, { key, chart, plot }) => {
    const tools = document.createElement("div");
    tools.className = "tools";
    const add = (text, name, change) => {
      const button = tools.appendChild(document.createElement("button"));
      button.type = "button";
      button.textContent = text;
      button.setAttribute("aria-label", name);
      button.addEventListener("click", () => {
        const { min, max } = chart.scales.x;
        // A logarithmic axis is zoomed in its logarithm.
        const [to, from] = plot.x.log ? [Math.log, Math.exp] : [(v) => v, (v) => v];
        const [low, high] = change(to(min), to(max));
        const [first, last] = [to(plot.x.low), to(plot.x.high)];
        const span = Math.min(high - low, last - first);
        const begin = Math.max(first, Math.min(low, last - span));
        zoom(key, from(begin), from(begin + span));
      });
    };
    add("+", "zoom in", (low, high) => [low + (high - low) / 4, high - (high - low) / 4]);
    add("\u2212", "zoom out", (low, high) => [low - (high - low) / 2, high + (high - low) / 2]);
    add("\u2190", "earlier", (low, high) => [low - (high - low) / 4, high - (high - low) / 4]);
    add("\u2192", "later", (low, high) => [low + (high - low) / 4, high + (high - low) / 4]);
    add("All", "show all", () => [-Infinity, Infinity]);
    tools.append("Drag to zoom; a double click shows all.");
    figure.prepend(tools);
  };

  for (const figure of document.querySelectorAll("figure")) {
    const made = [...figure.querySelectorAll("[data-plot]")].map(build);
    if (made.length) addTools(figure, made[0]);
  }
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    for (const charts of groups.values()) for (const { chart } of charts) chart.redraw();
  });
})();
