"use strict";
// One study, live. The server tells what is new; everything is drawn from what it told. Text goes in as text, never as markup.
const BASE = location.pathname.replace(/\/$/, "");
const where = (id) => document.getElementById(id);
const rows = new Map(), lines = new Map(), drawings = new Map(), places = new Map();
// A browser takes seconds over a table of thousands of lines: more are added when one scrolls to the end.
const MORE = 100;
const sorting = { key: "number", down: true, count: MORE };
let head = null, result = null, untuned = null, tuned = null, tunedLabel = "tuned", chosen = fromAddress();
let columns = [];

const FIXED = [
  { key: "number", title: "trial", value: (row) => row.number },
  { key: "status", title: "status", text: true, value: (row) => row.status },
  { key: "limits", title: "limits", text: true, value: (row) => (row.feasible === null ? "" : row.feasible ? "kept" : "broken") },
  { key: "loss", title: "loss", value: (row) => row.loss },
  { key: "excess", title: "worst excess", value: (row) => row.excess },
];
const LAST = [{ key: "ending", title: "ending", text: true, value: (row) => row.ending }];

const short = (value) => (typeof value === "number" ? (Number.isInteger(value) ? String(value) : value.toPrecision(4)) : value || "-");

function fromAddress() {
  return location.hash.slice(1).split(",").filter((part) => /^\d{1,9}$/.test(part)).map(Number).slice(0, 2);
}

// The table

function findColumns() {
  const names = new Set(columns.filter(({ metric }) => metric).map(({ key }) => key));
  const before = names.size;
  for (const row of rows.values()) for (const name of Object.keys(row.metrics)) names.add(name);
  if (columns.length && names.size === before) return;
  const metrics = [...names].map((name) => ({ key: name, title: name, metric: true, value: (row) => row.metrics[name] ?? null }));
  columns = [...FIXED, ...metrics, ...LAST];
  lines.clear();
  where("headings").replaceChildren(...columns.map((column) => {
    const heading = document.createElement("th"), button = document.createElement("button");
    heading.scope = "col";
    heading.className = column.text ? "text" : "";
    heading.dataset.key = column.key;
    button.type = "button";
    button.textContent = column.title;
    button.addEventListener("click", () => {
      sorting.down = sorting.key === column.key ? !sorting.down : false;
      sorting.key = column.key;
      sorting.count = MORE;
      where("table").scrollTop = 0;
      showTable();
    });
    heading.append(button);
    return heading;
  }));
}

function tableLine(row) {
  const line = document.createElement("tr");
  line.dataset.number = row.number;
  for (const column of columns) {
    const node = document.createElement("td"), value = column.value(row);
    node.className = column.text ? "text" : "";
    if (value === "broken" || value === "failed") node.classList.add("bad");
    if (column.key === "number") {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = String(value);
      node.append(button);
    } else node.textContent = short(value);
    line.append(node);
  }
  return line;
}

function showTable() {
  findColumns();
  const value = columns.find(({ key }) => key === sorting.key).value, sign = sorting.down ? -1 : 1;
  const none = (v) => v === null || v === "" || v === undefined;
  // What has no value stays below, whichever way.
  const sorted = [...rows.values()].sort((a, b) => {
    const x = value(a), y = value(b);
    if (none(x) || none(y)) return none(x) - none(y) || a.number - b.number;
    return (x < y ? -1 : x > y ? 1 : 0) * sign || a.number - b.number;
  });
  where("rows").replaceChildren(...sorted.slice(0, sorting.count).map((row) => {
    if (!lines.has(row.number)) lines.set(row.number, tableLine(row));
    return lines.get(row.number);
  }));
  for (const heading of where("headings").children) {
    heading.ariaSort = heading.dataset.key === sorting.key ? (sorting.down ? "descending" : "ascending") : "none";
  }
  markLines();
}

function markLines() {
  for (const [number, line] of lines) {
    line.classList.toggle("chosen", chosen.includes(number));
    line.classList.toggle("best", number === tuned);
  }
}

function choose(number) {
  chosen = chosen.includes(number) ? chosen.filter((other) => other !== number) : [...chosen, number].slice(-2);
  history.replaceState(null, "", chosen.length ? `#${chosen.join(",")}` : location.pathname);
  markLines();
  draw();
}

where("rows").addEventListener("click", (event) => {
  const line = event.target.closest("tr");
  if (line) choose(Number(line.dataset.number));
});

where("table").addEventListener("scroll", () => {
  const { scrollTop, clientHeight, scrollHeight } = where("table");
  if (scrollTop + 2 * clientHeight > scrollHeight && sorting.count < rows.size) {
    sorting.count += MORE;
    showTable();
  }
});

// The figures

async function drawing(number) {
  const row = rows.get(number);
  if (!row) return null;
  const known = drawings.get(number);
  // A running trial has no trace yet; it is asked for again when it is told.
  if (known && known.status === row.status) return known.content;
  const answer = await fetch(`${BASE}/trials/${number}`);
  const content = await answer.json();
  if (!answer.ok) throw new Error(content.message);
  drawings.set(number, { status: row.status, content });
  return content;
}

function newest() {
  let found = null;
  for (const row of rows.values()) {
    if (row.trace && (found === null || row.told_at > found.told_at || (row.told_at === found.told_at && row.number > found.number))) found = row;
  }
  return found === null ? null : found.number;
}

function wanted() {
  const list = [{ label: `newest (trial ${newest()})`, colour: "trials", number: newest() }];
  list.push({ label: `untuned (trial ${untuned})`, colour: "untuned", number: untuned });
  list.push({ label: `${tunedLabel} (trial ${tuned})`, colour: "tuned", number: tuned, dash: tuned === untuned ? "dash" : "" });
  const [one, other] = chosen;
  list.push({ label: `trial ${one}`, colour: "one", number: one ?? null, dash: "dot" });
  list.push({ label: `trial ${other}`, colour: "other", number: other ?? null, dash: "dot" });
  return list.filter(({ number }) => number !== null && number !== undefined && rows.has(number));
}

function place(parent, key, caption, tall = false) {
  const id = `${parent} ${key}`;
  if (!places.has(id)) places.set(id, Figures.place(where(parent), caption, tall));
  return places.get(id);
}

// The largest file by far: the table need not wait for it.
const plotly = new Promise((loaded, failed) => {
  const script = document.createElement("script");
  script.addEventListener("load", loaded);
  script.addEventListener("error", () => failed(new Error("plotly.js did not load")));
  script.src = "/static/plotly.js";
  document.head.append(script);
});

let drawingNow = false, drawAgain = false;

// One drawing at a time; what changes meanwhile is drawn right after it.
async function draw() {
  if (drawingNow) {
    drawAgain = true;
    return;
  }
  drawingNow = true;
  try {
    do {
      drawAgain = false;
      await drawOnce();
    } while (drawAgain);
  } catch (error) {
    where("message").textContent = `A trial cannot be drawn: ${error.message}`;
  } finally {
    drawingNow = false;
  }
}

async function drawOnce() {
  const entries = wanted();
  const asked = Promise.all(entries.map(async (entry) => ({ ...entry, drawing: await drawing(entry.number) })));
  const [drawn] = await Promise.all([asked, plotly]);
  const shown = drawn.filter((entry) => entry.drawing);
  Figures.legend(where("legend"), [...shown, { label: "limit", colour: "limit", dash: true }]);
  const panels = new Map(), profiles = new Map();
  for (const { drawing: found } of shown) {
    for (const panel of found.panels) if (!panels.has(panel.key)) panels.set(panel.key, panel);
    for (const profile of found.profiles) if (!profiles.has(profile.key)) profiles.set(profile.key, profile);
  }
  where("learned").hidden = profiles.size === 0;
  // Every place first: a figure is as wide as its neighbours let it be.
  const signals = [...panels.values()].map((panel) => [place("signals", panel.key, panel.label), panel]);
  const learned = [...profiles.values()].map(({ key, label }) => [place("profiles", key, label), key]);
  for (const [node, panel] of signals) await Figures.overTime(node, panel, shown);
  for (const [node, key] of learned) await Figures.overSoc(node, key, shown);
  const list = [...rows.values()].sort((a, b) => a.number - b.number);
  const marked = entries.filter(({ colour }) => colour !== "trials").map((entry) => ({ ...entry, row: rows.get(entry.number) }));
  const all = place("convergence", "all", "each trial, and the best so far; a point can be chosen", true);
  await Figures.convergence(all, head, list, marked);
  if (!all.dataset.listens) {
    all.dataset.listens = "yes";
    all.on("plotly_click", ({ points }) => choose(points[0].x));
  }
  where("message").textContent = shown.filter(({ number, drawing: found }) => found.message && chosen.includes(number))
    .map(({ number, drawing: found }) => `Trial ${number}: ${found.message}.`).join(" ");
  compare(shown);
  document.documentElement.dataset.drawn = String(list.length);
}

function compare(shown) {
  const picked = chosen.map((number) => shown.find((entry) => entry.number === number && (entry.colour === "one" || entry.colour === "other"))).filter(Boolean);
  where("compared").hidden = picked.length === 0;
  if (!picked.length) return;
  where("downloads").replaceChildren(...picked.flatMap(({ number }) => {
    const links = [["theta.json", `theta of trial ${number} (JSON)`]];
    if (rows.get(number).trace) links.push(["trace.csv", `trace of trial ${number} (CSV)`]);
    return links.flatMap(([file, text]) => {
      const link = document.createElement("a");
      link.href = `${BASE}/trials/${number}/${file}`;
      link.download = "";
      link.textContent = text;
      return [link, " "];
    });
  }));
  const titles = ["", ...picked.map(({ number }) => `trial ${number}`), ...(picked.length === 2 ? ["difference"] : [])];
  where("compared-head").replaceChildren(...titles.map((title, i) => {
    const heading = document.createElement("th");
    heading.scope = "col";
    heading.className = i ? "" : "text";
    heading.textContent = title;
    return heading;
  }));
  const body = [];
  const add = (name, values) => {
    const line = document.createElement("tr");
    const numbers = values.every((value) => typeof value === "number");
    const texts = [name, ...values.map(short), ...(values.length === 2 ? [numbers ? short(values[1] - values[0]) : "-"] : [])];
    texts.forEach((text, i) => {
      const node = document.createElement("td");
      node.className = i ? "" : "long text";
      node.textContent = text;
      line.append(node);
    });
    body.push(line);
  };
  const both = picked.map(({ number }) => rows.get(number));
  for (const column of [...FIXED.slice(1), ...columns.filter(({ metric }) => metric)]) {
    const unit = column.key === "excess" ? ` (${head.excess_unit})` : "";
    add(`${column.title}${unit}`, both.map((row) => column.value(row)));
  }
  for (const { entry, unit } of head.theta) add(unit === "1" ? entry : `${entry} (${unit})`, picked.map(({ drawing: found }) => found.theta[entry]));
  where("compared-rows").replaceChildren(...body);
}

// What the server tells

function tell() {
  const list = [...rows.values()], count = (test) => list.filter(test).length;
  where("counts").textContent = `${list.length} trials: ${count((row) => row.feasible === true)} within the limits, `
    + `${count((row) => row.feasible === false)} beyond one, ${count((row) => row.status === "failed")} failed, `
    + `${count((row) => row.status === "running")} running.`;
}

const source = new EventSource(`${BASE}/stream`);
const state = (text, kind) => {
  where("state").textContent = text;
  where("state").className = kind;
};

function about() {
  const why = result && (result.trial === null ? `no result: ${result.sentence}` : `the result is trial ${result.trial}: ${result.sentence}`);
  const parts = [head.cell, head.tuner && `tuner ${head.tuner}`, `${head.theta.length} entries of theta`, head.remark, why];
  where("about").textContent = parts.filter(Boolean).join("; ");
}
source.addEventListener("study", (event) => {
  head = JSON.parse(event.data);
  rows.clear();
  lines.clear();
  document.title = `chargetune: ${head.name}`;
  where("name").textContent = head.name;
  about();
});
source.addEventListener("trials", (event) => {
  const news = JSON.parse(event.data);
  for (const row of news.rows) {
    rows.set(row.number, row);
    lines.delete(row.number);
  }
  ({ untuned, tuned, tuned_label: tunedLabel, result } = news);
  about();
  tell();
  showTable();
  state("live", "good");
  draw();
});
source.addEventListener("trouble", (event) => state(JSON.parse(event.data).message, "bad"));
source.onerror = () => {
  // A browser tries again by itself unless it was refused.
  const refused = source.readyState === EventSource.CLOSED;
  state(refused ? "the server refuses; load the page again" : "no connection to the server, trying again", "bad");
};
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => head && draw());
window.addEventListener("hashchange", () => {
  chosen = fromAddress();
  markLines();
  draw();
});
