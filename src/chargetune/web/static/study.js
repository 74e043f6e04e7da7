"use strict";
// One study, live. The server tells what is new; everything is drawn from what it told. Text goes in as text, never as markup.
const BASE = location.pathname.replace(/\/$/, "");
const where = (id) => document.getElementById(id);
const rows = new Map(), drawings = new Map(), places = new Map();
let head = null, result = null, start = null, startLabel = "untuned", tuned = null, tunedLabel = "tuned", chosen = fromAddress();
const table = Trials(where, rows, choose);
const sliceOver = Slices(where, () => draw());

function fromAddress() {
  return location.hash.slice(1).split(",").filter((part) => /^\d{1,9}$/.test(part)).map(Number).slice(0, 2);
}

function choose(number) {
  chosen = chosen.includes(number) ? chosen.filter((other) => other !== number) : [...chosen, number].slice(-2);
  history.replaceState(null, "", chosen.length ? `#${chosen.join(",")}` : location.pathname);
  table.choose(chosen);
  draw();
}

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
  // Where the newest one is the result it would lie below it.
  const list = newest() === tuned ? [] : [{ label: `newest (trial ${newest()})`, colour: "trials", number: newest() }];
  list.push({ label: `${startLabel} (trial ${start})`, colour: "untuned", number: start });
  list.push({ label: `${tunedLabel} (trial ${tuned})`, colour: "tuned", number: tuned, dash: tuned === start ? "dash" : "" });
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
  const limited = shown.some(({ drawing: found }) => found.panels.some((panel) => panel.limits.length));
  Figures.legend(where("legend"), [...shown, ...(limited ? [{ label: "limit", colour: "limit", dash: true }] : [])]);
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
  const all = place("convergence", "all", `${Figures.ofConvergence(head)}; a point can be chosen`, true);
  await Figures.convergence(all, head, list, marked);
  if (!all.dataset.listens) {
    all.dataset.listens = "yes";
    all.on("plotly_click", ({ points }) => choose(points[0].x));
  }
  const theta = place("parallel", "all", "theta of every trial (parallel coordinates)", true), slices = place("slices", "one", "each trial over one entry of theta");
  await Figures.parallel(theta, head, list, marked);
  await Figures.slice(slices, head, list, sliceOver(head, list), marked);
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
  add("status", both.map((row) => row.status));
  add("limits", both.map((row) => (row.feasible === null ? "" : row.feasible ? "kept" : "broken")));
  add(head.objective.label, both.map((row) => row.value));
  for (const { name, label, unit } of head.excesses) add(named(label, unit), both.map((row) => row.excesses[name] ?? null));
  for (const [name, [label, unit]] of Object.entries(head.metrics)) {
    const values = both.map((row) => row.metrics[name] ?? null);
    if (values.some((value) => value !== null)) add(named(label, unit), values);
  }
  for (const { entry, unit } of head.theta) add(named(entry, unit), picked.map(({ drawing: found }) => found.theta[entry]));
  where("compared-rows").replaceChildren(...body);
}

// What the server tells

function tell() {
  const list = [...rows.values()], count = (test) => list.filter(test).length;
  where("counts").textContent = `${counted(list.length, "trial")}: ${count((row) => row.feasible === true)} within the limits, `
    + `${count((row) => row.feasible === false)} beyond one, ${count((row) => row.status === "failed")} failed, `
    + (count((row) => row.status === "apart") ? `${count((row) => row.status === "apart")} set apart, ` : "")
    + `${count((row) => row.status === "running")} running.`;
}

const source = new EventSource(`${BASE}/stream`);
const state = (text, kind) => {
  where("state").textContent = text;
  where("state").className = kind;
};

function about() {
  const why = result && (result.trial === null ? `no result: ${result.sentence}` : `the result is trial ${result.trial}: ${result.sentence}`);
  const parts = [head.cell, head.tuner && `tuner ${head.tuner}`,
    counted(head.theta.length, "entry of theta", "entries of theta"), head.remark, why];
  where("about").textContent = parts.filter(Boolean).join("; ");
}
source.addEventListener("study", (event) => {
  head = JSON.parse(event.data);
  rows.clear();
  table.head(head);
  document.title = `chargetune: ${head.name}`;
  where("name").textContent = head.name;
  about();
});
source.addEventListener("trials", (event) => {
  const news = JSON.parse(event.data);
  for (const row of news.rows) {
    rows.set(row.number, row);
    table.changed(row.number);
  }
  ({ start, start_label: startLabel, tuned, tuned_label: tunedLabel, result } = news);
  table.results({ best: tuned, start, startLabel });
  about();
  tell();
  table.show();
  table.choose(chosen);
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
  table.choose(chosen);
  draw();
});
