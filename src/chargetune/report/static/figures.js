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
    return Plotly.react(node, data, common, { ...CONFIG, displayModeBar: touch ? false : "hover" });
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
    text, xref: "paper", yref: "paper", x: 0, y, xanchor: "left", yanchor: "bottom", showarrow: false, font: { color: colour("faint") },
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
    return plot(node, data, { xaxis: axis(panel.time, { rangemode: "tozero" }), yaxis: y, shapes: panel.limits.map(level) });
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

  // Linear within 1 on either side of the limit, logarithmic beyond.
  const squeeze = (value) => value === null ? null : Math.sign(value) * Math.log10(1 + Math.abs(value));

  function incumbents(rows) {
    let best = null;
    return rows.map((row) => {
      if (row.counted && row.loss !== null && (best === null || row.loss < best)) best = row.loss;
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

  function convergence(node, head, rows, marked = []) {
    const kinds = [
      ["within limits", "ok", "circle", (row) => row.feasible === true],
      ["violating", "limit", "triangle-up-open", (row) => row.feasible === false],
    ];
    const data = [];
    let thinned = false;
    for (const [name, ink, symbol, belongs] of kinds) {
      const all = rows.filter(belongs), marker = { color: colour(ink), symbol, size: 7 };
      thinned = thinned || all.length > 3 * STRETCHES;
      const upper = extremes(all, (row) => row.loss), lower = extremes(all, (row) => row.excess);
      data.push({
        x: upper.map((row) => row.number), y: upper.map((row) => row.loss), name, mode: "markers", marker,
        hovertemplate: "trial %{x}: %{y:.5g}<extra></extra>",
      });
      data.push({
        x: lower.map((row) => row.number), y: lower.map((row) => squeeze(row.excess)), text: lower.map((row) => row.excess?.toPrecision(4) ?? ""),
        name, yaxis: "y2", mode: "markers", marker, showlegend: false, hovertemplate: `trial %{x}: %{text} ${head.excess_unit}<extra></extra>`,
      });
    }
    const failed = rows.filter((row) => row.status === "failed");
    if (failed.length) {
      data.push({
        x: failed.map((row) => row.number), y: failed.map(() => 0.04), text: failed.map((row) => row.ending), name: "failed", yaxis: "y3",
        mode: "markers", marker: { color: colour("ink"), symbol: "x-thin-open", size: 8 }, hovertemplate: "trial %{x} failed<extra></extra>",
      });
    }
    data.push({
      x: rows.map((row) => row.number), y: incumbents(rows), name: "best so far", mode: "lines", hoverinfo: "skip",
      line: { color: colour("tuned"), width: 2, shape: "hv" },
    });
    for (const { row, label, colour: ink } of marked) {
      if (!row || row.loss === null) continue;
      const marker = { color: colour(ink), symbol: "circle-open", size: 15, line: { width: 2.5 } };
      data.push({ x: [row.number], y: [row.loss], name: label, mode: "markers", marker, hoverinfo: "skip", showlegend: false });
      data.push({ x: [row.number], y: [squeeze(row.excess)], yaxis: "y2", mode: "markers", marker, hoverinfo: "skip", showlegend: false });
    }
    const losses = rows.map((row) => row.loss).filter((value) => value !== null);
    // Below a decade a logarithmic axis says no more than a linear one.
    const logarithmic = losses.length > 0 && Math.min(...losses) > 0 && Math.max(...losses) > 10 * Math.min(...losses);
    // Without any score there is no curve in the lower half, and plotly would leave out the axis that the upper one stands on.
    if (!losses.length) data.push({ x: [0], y: [null], yaxis: "y2", mode: "lines", showlegend: false });
    const ticks = [-1000, -100, -10, -1, 0, 1, 10, 100, 1000];
    const limits = [{ ...level(0), yref: "y2" }];
    if (head.tolerance) limits.push({ ...level(squeeze(head.tolerance)), yref: "y2", line: { color: colour("limit"), width: 1, dash: "dot" } });
    return plot(node, data, {
      xaxis: axis("trial", { anchor: "y2", range: [-0.03 * rows.length - 0.5, 1.03 * rows.length] }),
      yaxis: axis("", { domain: [0.54, 1], type: logarithmic ? "log" : "linear", exponentformat: "power" }),
      yaxis2: axis("", { domain: [0, 0.42], tickvals: ticks.map(squeeze), ticktext: ticks.map(String) }),
      yaxis3: { overlaying: "y", range: [0, 1], visible: false, fixedrange: true },
      // Beside the axes the titles would take what a narrow screen has of width.
      annotations: [heading(head.loss_label + (thinned ? "; not every trial, but every extreme one" : ""), 1), heading(`worst excess (${head.excess_unit})`, 0.42)],
      shapes: limits, showlegend: true, legend: { orientation: "h", y: 1.07, yanchor: "bottom", x: 0 },
      margin: { l: 48, r: 12, t: 56, b: 40 },
    });
  }

  // Two bars an entry: what moving it down and up does.
  function bars(node, entries, down, up, unit, step) {
    const bar = (values, name, ink) => ({
      type: "bar", orientation: "h", y: entries, x: values, name, marker: { color: colour(ink) }, hovertemplate: `%{y}: %{x:.3g} ${unit}<extra>${name}</extra>`,
    });
    node.style.height = `${110 + 24 * entries.length}px`;
    return plot(node, [bar(down, `-${step}`, "untuned"), bar(up, `+${step}`, "tuned")], {
      barmode: "group", bargap: 0.25, xaxis: axis(`change (${unit})`, { exponentformat: "e" }), yaxis: axis("", { autorange: "reversed", dtick: 1 }),
      showlegend: true, legend: { orientation: "h", y: 1.01, yanchor: "bottom", x: 0 }, margin: { l: 48, r: 12, t: 30, b: 40 },
    });
  }

  // plotly looks at the window only, but a figure also becomes narrower when others come beside it.
  const resizing = new ResizeObserver((changes) => {
    for (const { target } of changes) if (target.classList.contains("js-plotly-plot") && target.clientWidth) Plotly.Plots.resize(target);
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

  return { overTime, overSoc, convergence, bars, place, legend, incumbents };
})();
