"use strict";
// The figures of a page: one drawing function a kind, used by the report and by the live page alike.
const Figures = (() => {
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  // Allowed by name: what a newer plotly.js adds, such as a button that uploads the chart, does not appear unasked.
  const CONFIG = {
    displaylogo: false, plotlyServerURL: "", showSendToCloud: false, showLink: false,
    modeBarButtons: [["toImage"], ["zoom2d", "pan2d", "zoomIn2d", "zoomOut2d", "resetScale2d"]],
  };

  function axis(title, more) {
    const line = colour("line");
    return {
      title: { text: title, standoff: 6 }, gridcolor: line, linecolor: line, zerolinecolor: line, automargin: true, ...more,
    };
  }

  function plot(node, data, layout) {
    // A finger on a figure scrolls the page.
    const touch = matchMedia("(pointer: coarse)").matches;
    const common = {
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { color: colour("ink"), size: 12 },
      margin: { l: 48, r: 12, t: 10, b: 40 }, showlegend: false, hovermode: "closest", dragmode: touch ? false : "zoom",
      hoverlabel: { bgcolor: colour("card"), bordercolor: colour("line"), font: { color: colour("ink") } },
      // What a person zoomed into stays when new trials arrive.
      uirevision: "kept", ...layout,
    };
    const done = Plotly.react(node, data, common, { ...CONFIG, displayModeBar: touch ? false : "hover" });
    return done.then(() => scalable(node));
  }

  // With a viewBox the figure can be made as wide as the paper, without being drawn again.
  function scalable(node) {
    const width = node.clientWidth, height = node.clientHeight;
    if (!width || !height) return;
    for (const svg of node.querySelectorAll(".main-svg")) svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    node.style.setProperty("--ratio", `${width} / ${height}`);
  }

  const level = (value) => ({
    type: "line", xref: "paper", x0: 0, x1: 1, y0: value, y1: value, line: { color: colour("limit"), width: 1.5, dash: "dash" },
  });

  // All other trials as one curve with gaps: a hundred separate ones would be slow.
  function many(list, pick) {
    const x = [], y = [];
    for (const drawing of list) {
      const curve = pick(drawing);
      if (curve) { x.push(...curve.x, null); y.push(...curve.y, null); }
    }
    return { x, y, mode: "lines", line: { color: colour("trials"), width: 0.6 }, opacity: 0.55, hoverinfo: "skip", connectgaps: false };
  }

  const heading = (text, y) => ({
    text, xref: "paper", yref: "paper", x: 0, y, xanchor: "left", yanchor: "bottom", showarrow: false, font: { color: colour("faint"), size: 12 },
  });

  const find = (list, key) => list.find((entry) => entry.key === key);

  // shown: [{label, colour, dash, drawing}], from the back to the front.
  function overTime(node, panel, shown, others = []) {
    const data = others.length ? [many(others, (drawing) => find(drawing.panels, panel.of))] : [];
    for (const { label, colour: name, dash, drawing } of shown) {
      const curve = find(drawing.panels, panel.of);
      if (!curve) continue;
      data.push({ x: curve.x, y: curve.y, name: label, mode: "lines", line: { color: colour(name), width: 1.8, dash: dash || "solid" } });
    }
    const y = axis("");
    if (panel.shown) y.range = panel.shown;
    const [low, high] = panel.shown || [-Infinity, Infinity];
    const there = data.some((one) => one.y.some((value) => value !== null && value >= low && value <= high));
    const said = { text: "nothing comes near the limit", xref: "paper", yref: "paper", x: 0.5, y: 0.25, showarrow: false, font: { color: colour("faint") } };
    return plot(node, data, {
      xaxis: axis(panel.time, { rangemode: "tozero" }), yaxis: y, shapes: panel.limits.map(level), annotations: data.length && !there ? [said] : [],
    });
  }

  function overSoc(node, key, shown, others = []) {
    const data = others.length ? [many(others, (drawing) => find(drawing.profiles, key))] : [];
    let beside = null;
    for (const { label, colour: name, dash, drawing } of shown) {
      const curve = find(drawing.profiles, key);
      if (!curve) continue;
      beside = beside || curve.beside;
      data.push({ x: curve.x, y: curve.y, name: label, mode: "lines", line: { color: colour(name), width: 1.8, dash: dash || "solid" } });
      data.push({ x: curve.nodes_x, y: curve.nodes_y, name: label, mode: "markers", marker: { color: colour(name), size: 6 } });
    }
    if (beside) {
      data.push({ x: beside.x, y: beside.y, name: beside.label, mode: "lines", line: { color: colour("ink"), width: 1.5, dash: "dot" } });
    }
    return plot(node, data, { xaxis: axis("SOC (%)", { range: [0, 100] }), yaxis: axis("") });
  }

  // Linear within so much on either side of the limit, logarithmic beyond.
  const squeeze = (value, within) => value === null || value === undefined ? null : Math.sign(value) * Math.log10(1 + Math.abs(value) / within);

  // The best value up to each trial, of those that count.
  function incumbents(rows, larger = false) {
    let best = null;
    return rows.map((row) => {
      if (row.counted && row.value !== null && (best === null || (larger ? row.value > best : row.value < best))) best = row.value;
      return best;
    });
  }

  // Thousands of points cost a browser a second and cannot be told apart: of neighbours the smallest, the largest and one more are kept.
  const STRETCHES = 150;

  function extremes(list, value) {
    if (list.length <= 3 * STRETCHES) return list;
    const kept = new Set();
    for (let i = 0; i < STRETCHES; i += 1) {
      const part = list.slice(Math.floor((i * list.length) / STRETCHES), Math.floor(((i + 1) * list.length) / STRETCHES));
      kept.add(part.reduce((a, b) => (value(b) < value(a) ? b : a)));
      kept.add(part.reduce((a, b) => (value(b) > value(a) ? b : a)));
      kept.add(part[Math.floor(part.length / 2)]);
    }
    return list.filter((row) => kept.has(row));
  }

  const KINDS = [
    ["within limits", "ok", "circle", (row) => row.feasible === true],
    ["over a limit", "limit", "triangle-up-open", (row) => row.feasible === false],
  ];
  const unit = (text) => (text ? ` (${text})` : "");
  const decade = (values) => values.length > 0 && Math.min(...values) > 0 && Math.max(...values) > 10 * Math.min(...values);

  // Where each trial is under a condition of its own none is the best so far.
  const ofConvergence = ({ objective }) => (objective.comparable ? "each trial, and the best so far" : "each trial; each under a condition of its own");

  // Above what each trial was worth, below one panel a limit, in its own unit.
  function convergence(node, head, rows, marked = []) {
    const limits = head.excesses.filter(({ drawn }) => drawn), data = [], shapes = [], annotations = [];
    const count = 1 + limits.length, share = 1 / (count + 0.35), gap = 0.3 * share, layout = {};
    const above = { low: 1 - 1.35 * share, high: 1 };
    const span = (k) => [(limits.length - 1 - k) * share, (limits.length - k) * share - gap];
    node.style.height = `${130 + 190 * count}px`;
    let thinned = false;
    const axisOf = (k) => `y${k + 2}`;
    for (const [name, ink, symbol, belongs] of KINDS) {
      const all = rows.filter(belongs), marker = { color: colour(ink), symbol, size: 7 };
      thinned = thinned || all.length > 3 * STRETCHES;
      const upper = extremes(all, (row) => row.value);
      data.push({
        x: upper.map((row) => row.number), y: upper.map((row) => row.value), name, mode: "markers", marker,
        hovertemplate: "trial %{x}: %{y:.5g}<extra></extra>",
      });
      limits.forEach((limit, k) => {
        const lower = extremes(all, (row) => row.excesses[limit.name]);
        data.push({
          x: lower.map((row) => row.number), y: lower.map((row) => squeeze(row.excesses[limit.name], limit.within)), name, yaxis: axisOf(k), mode: "markers", marker,
          text: lower.map((row) => row.excesses[limit.name]?.toPrecision(4) ?? ""), showlegend: false,
          hovertemplate: `trial %{x}: %{text} ${limit.unit}<extra></extra>`,
        });
      });
    }
    // Without a value the mark stands at the foot of the axis.
    for (const [status, name, symbol] of [["failed", "failed", "x-thin-open"], ["apart", "set apart", "line-ns-open"]]) {
      const without = rows.filter((row) => row.status === status);
      if (without.length) {
        data.push({
          x: without.map((row) => row.number), y: without.map(() => 0.04), name, yaxis: "y99", mode: "markers",
          marker: { color: colour("ink"), symbol, size: 8 }, hovertemplate: `trial %{x} ${name}<extra></extra>`,
        });
      }
    }
    const courseOfBest = head.objective.comparable ? incumbents(rows, head.objective.larger) : [];
    if (courseOfBest.some((value) => value !== null)) {
      data.push({
        x: rows.map((row) => row.number), y: courseOfBest, name: "best so far", mode: "lines", hoverinfo: "skip",
        line: { color: colour("tuned"), width: 2, shape: "hv" },
      });
    }
    const values = rows.map((row) => row.value).filter((value) => value !== null), ends = [-0.02 * rows.length - 0.5, 1.02 * rows.length - 0.5];
    const line = (value, name, dash, ink) => data.push({ x: ends, y: [value, value], name, mode: "lines", hoverinfo: "name", line: { color: colour(ink), width: 1.5, dash } });
    if (head.objective.possible !== null && values.length) line(head.objective.possible, "best possible", "dot", "ink");
    if (head.objective.most && values.some((value) => value > head.objective.most * 1.000001)) line(head.objective.most, "above: not reached", "dashdot", "faint");
    for (const { row, label, colour: ink } of marked) {
      if (!row || row.value === null) continue;
      const marker = { color: colour(ink), symbol: "circle-open", size: 15, line: { width: 2.5 } };
      data.push({ x: [row.number], y: [row.value], name: label, mode: "markers", marker, hoverinfo: "skip" });
      limits.forEach(({ name, within }, k) => data.push({ x: [row.number], y: [squeeze(row.excesses[name], within)], yaxis: axisOf(k), mode: "markers", marker, hoverinfo: "skip", showlegend: false }));
    }
    // Without any score there is no curve below, and plotly would leave out the axis that the upper one stands on.
    if (limits.length && !values.length) data.push({ x: [0], y: [null], yaxis: axisOf(limits.length - 1), mode: "lines", showlegend: false });
    limits.forEach((limit, k) => {
      const squeezed = rows.map((row) => squeeze(row.excesses[limit.name], limit.within)).filter((value) => value !== null);
      const low = Math.min(-squeeze(1, 1), ...squeezed), high = Math.max(squeeze(1, 1), ...squeezed), room = 0.08 * (high - low);
      // Over several decades the ones would stand on the zero.
      const between = high - low < 3.5 ? [-300, -30, 30, 300] : [];
      const ticks = [-1000, -100, -10, ...between, ...(high - low < 2 ? [-1, 0, 1] : [0]), 10, 100, 1000];
      layout[`yaxis${k + 2}`] = axis("", { domain: span(k), tickvals: ticks.map((tick) => squeeze(tick, 1)), ticktext: ticks.map((tick) => String(Number((tick * limit.within).toPrecision(1)))), range: [low - room, high + room] });
      shapes.push({ ...level(0), yref: axisOf(k) });
      if (limit.tolerance) shapes.push({ ...level(squeeze(limit.tolerance, limit.within)), yref: axisOf(k), line: { color: colour("limit"), width: 1, dash: "dot" } });
      annotations.push(heading(`${limit.label}${unit(limit.unit)}${limit.judged && node.clientWidth > 600 ? ", " + limit.judged : ""}`, span(k)[1]));
    });
    if (limits.length) {
      data.push({ x: [null], y: [null], name: "limit", mode: "lines", line: { color: colour("limit"), width: 1.5, dash: "dash" } });
      if (limits.some(({ tolerance }) => tolerance)) data.push({ x: [null], y: [null], name: "tolerance", mode: "lines", line: { color: colour("limit"), width: 1, dash: "dot" } });
    }
    // Beside the axes the titles would take what a narrow screen has of width.
    annotations.push(heading(head.objective.label + (thinned ? "; not every trial, but every extreme one" : ""), 1));
    return plot(node, data, {
      xaxis: axis("trial", { anchor: limits.length ? axisOf(limits.length - 1) : "y", range: ends, dtick: rows.length <= 12 ? 1 : undefined }),
      // Below a decade a logarithmic axis says no more than a linear one.
      yaxis: axis("", { domain: limits.length ? [above.low, above.high] : [0, 1], type: decade(values) ? "log" : "linear", exponentformat: "power" }),
      yaxis99: { overlaying: "y", range: [0, 1], visible: false, fixedrange: true }, ...layout,
      annotations, shapes, showlegend: true, legend: { orientation: "h", y: 1 + 28 / (20 + 190 * count), yanchor: "bottom", x: 0 },
      margin: { l: 48, r: 12, t: 74, b: 40 },
    });
  }

  // What was worth what over one entry of theta.
  function slice(node, head, rows, index, marked = []) {
    const { entry, unit: of, scale, lower, upper } = head.theta[index], data = [];
    for (const [name, ink, symbol, belongs] of KINDS) {
      const part = rows.filter(belongs);
      data.push({
        x: part.map((row) => row.theta[index]), y: part.map((row) => row.value), text: part.map((row) => row.number), name, mode: "markers",
        marker: { color: colour(ink), symbol, size: 7 }, hovertemplate: `trial %{text}: ${entry.replace(/[<>]/g, "")} %{x:.4g}, %{y:.5g}<extra></extra>`,
      });
    }
    for (const { row, label, colour: ink } of marked) {
      if (!row || row.value === null) continue;
      data.push({ x: [row.theta[index]], y: [row.value], name: label, mode: "markers", hoverinfo: "skip", marker: { color: colour(ink), symbol: "circle-open", size: 15, line: { width: 2.5 } } });
    }
    const log = scale === "log" && lower > 0, room = 0.03 * (log ? Math.log10(upper / lower) : upper - lower);
    const ends = log ? [Math.log10(lower) - room, Math.log10(upper) + room] : [lower - room, upper + room];
    return plot(node, data, {
      xaxis: axis(entry + unit(of), { type: log ? "log" : "linear", range: ends, dtick: log ? "D2" : undefined }), yaxis: axis(""),
      annotations: [heading(head.objective.label, 1)], showlegend: true, legend: { orientation: "h", y: 1.1, yanchor: "bottom", x: 0 },
      uirevision: entry, margin: { l: 48, r: 12, t: 66, b: 44 },
    });
  }

  // Every trial as a line through its theta, each entry as a share of its range.
  function parallel(node, head, rows, marked = []) {
    const names = head.theta.map(({ entry }) => entry), share = (value, { lower, upper, scale }) => (
      scale === "log" && lower > 0 ? Math.log(value / lower) / Math.log(upper / lower) : (value - lower) / (upper - lower || 1));
    const data = [], at = (row) => row.theta.map((value, i) => share(value, head.theta[i]));
    const kinds = [...KINDS, ["failed", "trials", "", (row) => row.status === "failed"]];
    for (const [name, ink, , belongs] of kinds) {
      const x = [], y = [];
      for (const row of rows.filter(belongs)) { x.push(...names, null); y.push(...at(row), null); }
      if (x.length) data.push({ x, y, name, mode: "lines", line: { color: colour(ink), width: 0.9 }, opacity: 0.5, connectgaps: false, hoverinfo: "skip" });
    }
    for (const { row, label, colour: ink } of marked) {
      if (!row) continue;
      data.push({
        x: names, y: at(row), name: label, mode: "lines+markers", line: { color: colour(ink), width: 2.4 }, marker: { size: 6 },
        text: row.theta.map((value, i) => `${value.toPrecision(4)} ${head.theta[i].unit}`), hovertemplate: "%{x}: %{text}<extra></extra>",
      });
    }
    return plot(node, data, {
      xaxis: axis("", { type: "category", categoryarray: names, tickangle: names.length > 6 ? -60 : "auto" }),
      yaxis: axis("", { range: [-0.03, 1.03], tickvals: [0, 0.5, 1], ticktext: ["lower", "middle", "upper"] }),
      annotations: [heading("share of the range between the bounds", 1)],
      showlegend: true, legend: { orientation: "h", y: 1.1, yanchor: "bottom", x: 0 }, margin: { l: 48, r: 12, t: 66, b: 60 },
    });
  }

  // One bar an entry: what is lost when it is put back; the text says what that does to the limits.
  function losses(node, { names, lost, unit: of, excess, excess_unit: limitUnit }) {
    const text = excess.map((value) => (value === null ? "" : `worst excess ${value > 0 ? "+" : ""}${value.toPrecision(3)} ${limitUnit}`));
    node.style.height = `${80 + 24 * names.length}px`;
    return plot(node, [{
      type: "bar", orientation: "h", y: names, x: lost, text, textposition: "none", marker: { color: colour("tuned") },
      hovertemplate: `%{y}: %{x:.3g} ${of}, %{text}<extra></extra>`,
    }], {
      xaxis: axis(`lost (${of})`, { exponentformat: "e" }), yaxis: axis("", { autorange: "reversed", dtick: 1 }), margin: { l: 48, r: 12, t: 10, b: 40 },
    });
  }

  // The best so far of several studies.
  function courses(node, { label, lines }) {
    const inks = ["tuned", "untuned", "one", "other", "limit", "trials"], dashes = ["solid", "dash", "dot", "dashdot"];
    return plot(node, lines.map(({ name, x, y }, i) => ({
      x, y, name, mode: "lines", line: { color: colour(inks[i % inks.length]), width: 2, shape: "hv", dash: dashes[Math.floor(i / inks.length) % 4] },
    })), {
      xaxis: axis("trial"), yaxis: axis(""), annotations: [heading(`${label}, best so far`, 1)],
      showlegend: true, legend: { orientation: "h", y: 1.1, yanchor: "bottom", x: 0 }, margin: { l: 48, r: 12, t: 66, b: 40 },
    });
  }

  // Two bars an entry: what moving it down and up does.
  function bars(node, entries, down, up, of, step) {
    const bar = (values, name, ink) => ({
      type: "bar", orientation: "h", y: entries, x: values, name, marker: { color: colour(ink) }, hovertemplate: `%{y}: %{x:.3g} ${of}<extra>${name}</extra>`,
    });
    node.style.height = `${110 + 24 * entries.length}px`;
    return plot(node, [bar(down, `-${step}`, "untuned"), bar(up, `+${step}`, "tuned")], {
      barmode: "group", bargap: 0.25, xaxis: axis(`change (${of})`, { exponentformat: "e" }), yaxis: axis("", { autorange: "reversed", dtick: 1 }),
      showlegend: true, legend: { orientation: "h", y: 1.01, yanchor: "bottom", x: 0 }, margin: { l: 48, r: 12, t: 30, b: 40 },
    });
  }

  // plotly looks at the window only, but a figure also becomes narrower when others come beside it.
  const resizing = new ResizeObserver((changes) => {
    for (const { target } of changes) if (target.classList.contains("js-plotly-plot") && target.clientWidth && !matchMedia("print").matches) {
      Plotly.Plots.resize(target).then(() => scalable(target), () => {});
    }
  });

  // A figure in the page: caption and place for the plot.
  function place(parent, caption, tall = false) {
    const figure = document.createElement("figure"), text = document.createElement("figcaption"), node = document.createElement("div");
    text.textContent = caption;
    node.className = tall ? "plot tall" : "plot";
    figure.append(text, node);
    parent.append(figure);
    resizing.observe(node);
    return node;
  }

  function legend(parent, entries) {
    parent.replaceChildren(...entries.map(({ label, colour: name, dash }) => {
      const item = document.createElement("span"), line = document.createElement("i");
      line.className = dash ? `${name} dash` : name;
      item.append(line, label);
      return item;
    }));
  }

  return { overTime, overSoc, convergence, slice, parallel, losses, courses, bars, place, legend, incumbents, ofConvergence };
})();
