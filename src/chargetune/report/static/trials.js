"use strict";
// The table of trials, and the figures of theta that are chosen above it: used by the report and by the live page alike.
// Text goes in as text, never as markup.
const short = (value) => (typeof value === "number" ? (Number.isInteger(value) ? String(value) : value.toPrecision(4)) : value || "-");
const counted = (count, one, many) => `${count} ${count === 1 ? one : many || `${one}s`}`;
const named = (text, unit) => (unit ? `${text} (${unit})` : text);

const Trials = (where, rows, choose) => {
  // A browser takes seconds over a table of thousands of lines: more are added when one scrolls to the end.
  const MORE = 100, FEW = 4;
  const sorting = { key: "number", down: true, count: MORE }, lines = new Map();
  let head = null, columns = [], drawn = "", best = null, start = null, startLabel = "untuned", chosen = [], theta = null;

  const tag = (row) => [row.number === best ? "result" : "", row.number === start ? startLabel : ""].filter(Boolean).join(", ");
  const verdict = (row) => (row.feasible === null ? "" : row.feasible ? "kept" : "broken");
  const kinds = {
    all: () => true, kept: (row) => row.feasible === true, "over a limit": (row) => row.feasible === false,
    failed: (row) => row.status === "failed", "set apart": (row) => row.status === "apart", running: (row) => row.status === "running", result: (row) => row.number === best,
  };

  // The tools above the table: which trials, and whether theta stands in it.
  const input = document.createElement("input"), select = document.createElement("select"), box = document.createElement("input"), said = document.createElement("span");
  const label = (text, node) => { const l = document.createElement("label"); l.append(text, node); return l; };
  function tools() {
    if (where("tools").children.length) return;
    input.type = "search";
    input.id = "filter";
    input.placeholder = "words, or R0_ratio[0] > 1.2";
    select.id = "kind";
    for (const kind of Object.keys(kinds)) select.append(new Option(kind, kind));
    box.type = "checkbox";
    box.id = "with-theta";
    box.checked = theta;
    said.className = "faint";
    said.id = "found";
    const boxed = document.createElement("label");
    boxed.append(box, " theta");
    where("tools").append(label("show ", select), label("filter ", input), boxed, said);
    for (const node of [input, select]) node.addEventListener("input", () => { sorting.count = MORE; show(); });
    box.addEventListener("input", () => { theta = box.checked; show(); });
  }

  // What is further than theta and limits stays off paper.
  const kindOf = (column) => [column.text ? "text" : "", column.further ? "further" : ""].filter(Boolean).join(" ");
  function findColumns() {
    const metrics = Object.entries(head.metrics).map(([key, [text, unit]]) => ({ key, title: named(text, unit), further: true, value: (row) => row.metrics[key] ?? null }));
    const entries = head.theta.map(({ entry, unit }, i) => ({ key: `theta ${entry}`, name: entry, title: named(entry, unit), further: head.theta.length > FEW, value: (row) => row.theta[i] }));
    const excesses = head.excesses.map(({ name, label: text, unit }) => ({ key: `excess ${name}`, name, title: named(text, unit), value: (row) => row.excesses[name] ?? null }));
    columns = [
      { key: "number", title: "trial", value: (row) => row.number },
      { key: "tag", title: "tag", text: true, value: tag },
      { key: "status", title: "status", text: true, value: (row) => row.status },
      { key: "limits", title: "limits", text: true, value: verdict },
      { key: "value", title: head.objective.label, value: (row) => row.value },
      ...excesses, ...(theta ? entries : []), ...metrics,
      { key: "ending", title: "ending", text: true, value: (row) => row.ending },
    ];
    const now = columns.map(({ key, title }) => key + title).join("\n");
    if (now === drawn) return;
    drawn = now;
    lines.clear();
    where("headings").replaceChildren(...columns.map((column) => {
      const heading = document.createElement("th"), button = document.createElement("button");
      heading.scope = "col";
      heading.className = kindOf(column);
      heading.dataset.key = column.key;
      button.type = "button";
      button.textContent = column.title;
      button.addEventListener("click", () => {
        sorting.down = sorting.key === column.key ? !sorting.down : false;
        sorting.key = column.key;
        sorting.count = MORE;
        where("table").scrollTop = 0;
        show();
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
      node.className = kindOf(column);
      if (column.key === "ending" && String(value).length > 40) node.className = "text long";
      if (value === "broken" || value === "failed") node.classList.add("bad");
      if (column.key === "number" && choose) {
        const button = document.createElement("button");
        button.type = "button";
        button.textContent = String(value);
        node.append(button);
      } else node.textContent = short(value);
      line.append(node);
    }
    return line;
  }

  // "R0_ratio[0] > 1.2" compares a column, anything else is looked for in the words of a row.
  function passes(row) {
    if (!kinds[select.value || "all"](row)) return false;
    const text = input.value.trim().toLowerCase();
    const found = /^(.+?)\s*(<=|>=|<|>|=)\s*(-?[\d.]+(?:e-?\d+)?)$/.exec(text);
    if (found) {
      const [, name, sign, number] = found, bound = Number(number);
      const entry = head.theta.findIndex((one) => one.entry.toLowerCase() === name);
      const column = columns.find((one) => [one.key, one.name, one.title].some((known) => known && known.toLowerCase() === name));
      const value = entry >= 0 ? row.theta[entry] : column ? column.value(row) : null;
      if (typeof value !== "number") return false;
      return sign === "<" ? value < bound : sign === ">" ? value > bound : sign === "<=" ? value <= bound : sign === ">=" ? value >= bound : value === bound;
    }
    return !text || [String(row.number), row.status, verdict(row), tag(row), row.ending].some((part) => part.toLowerCase().includes(text));
  }

  function show() {
    tools();
    findColumns();
    const value = (columns.find(({ key }) => key === sorting.key) || columns[0]).value, sign = sorting.down ? -1 : 1;
    const none = (v) => v === null || v === "" || v === undefined;
    const found = [...rows.values()].filter(passes);
    said.textContent = found.length === rows.size ? counted(rows.size, "trial") : `${found.length} of ${counted(rows.size, "trial")}`;
    // What has no value stays below, whichever way.
    found.sort((a, b) => {
      const x = value(a), y = value(b);
      if (none(x) || none(y)) return none(x) - none(y) || a.number - b.number;
      return (x < y ? -1 : x > y ? 1 : 0) * sign || a.number - b.number;
    });
    where("rows").replaceChildren(...found.slice(0, sorting.count).map((row) => {
      if (!lines.has(row.number)) lines.set(row.number, tableLine(row));
      return lines.get(row.number);
    }));
    for (const heading of where("headings").children) {
      heading.ariaSort = heading.dataset.key === sorting.key ? (sorting.down ? "descending" : "ascending") : "none";
    }
    mark();
  }

  function mark() {
    for (const [number, line] of lines) {
      line.classList.toggle("chosen", chosen.includes(number));
      line.classList.toggle("best", number === best);
    }
  }

  where("table").addEventListener("scroll", () => {
    const { scrollTop, clientHeight, scrollHeight } = where("table");
    if (scrollTop + 2 * clientHeight > scrollHeight && sorting.count < rows.size) {
      sorting.count += MORE;
      show();
    }
  });
  if (choose) {
    where("rows").addEventListener("click", (event) => {
      const line = event.target.closest("tr");
      if (line) choose(Number(line.dataset.number));
    });
  }

  return {
    show,
    head(content) {
      head = content;
      // Many entries would push everything else out of sight.
      if (theta === null) theta = head.theta.length <= FEW;
      lines.clear();
    },
    changed(number) { lines.delete(number); },
    results(of) {
      for (const number of [best, start, of.best, of.start]) lines.delete(number);
      ({ best, start, startLabel } = of);
    },
    choose(numbers) {
      chosen = numbers;
      mark();
    },
  };
};

// Which entry of theta the slice is over: a list above the figures, the widest moved entry first.
const Slices = (where, draw) => {
  const select = document.createElement("select");
  let known = "";
  select.id = "slice";
  select.addEventListener("input", () => draw());
  return (head, rows) => {
    const names = head.theta.map(({ entry }) => entry).join("\n");
    if (names !== known) {
      known = names;
      const moved = head.theta.map(({ lower, upper }, i) => {
        const values = rows.map((row) => row.theta[i]);
        return values.length ? (Math.max(...values) - Math.min(...values)) / (upper - lower || 1) : 0;
      });
      select.replaceChildren(...head.theta.map(({ entry }, i) => new Option(entry, i)));
      select.value = String(moved.indexOf(Math.max(...moved)));
      const label = document.createElement("label");
      label.append("slice over ", select);
      where("choice").replaceChildren(label);
    }
    return Number(select.value);
  };
};
