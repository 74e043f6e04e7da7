"use strict";
// Unpacks what the report carries along, and draws it. Nothing is fetched.
(async () => {
  const unpack = async (id) => {
    const bytes = Uint8Array.from(atob(document.getElementById(id).textContent), (letter) => letter.charCodeAt(0));
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  };
  const note = document.getElementById("drawing");
  try {
    const script = document.createElement("script");
    script.textContent = await unpack("plotly");
    document.head.append(script);
    const { head, rows, shown, others, sensitivity, importance, studies, result, start, start_label: startLabel } = JSON.parse(await unpack("data"));
    const where = (id) => document.getElementById(id);
    const redraw = [];
    const add = (id, caption, tall, draw) => {
      const node = Figures.place(where(id), caption, tall);
      redraw.push(() => draw(node));
    };
    const table = Trials(where, new Map(rows.map((row) => [row.number, row])), null);
    table.head(head);
    table.results({ best: result, start, startLabel });
    table.show();
    const entries = shown.map(({ label, colour, dash }) => ({ label, colour, dash }));
    if (others.length) entries.push({ label: `trials (${others.length} shown)`, colour: "trials" });
    const first = [...shown.map(({ drawing }) => drawing), ...others].find(({ panels }) => panels.length);
    const limits = first?.panels.some((panel) => panel.limits.length) ? [{ label: "limit", colour: "limit", dash: true }] : [];
    if (where("legend")) Figures.legend(where("legend"), [...entries, ...limits]);
    for (const panel of first?.panels || []) {
      add("signals", panel.label, false, (node) => Figures.overTime(node, panel, shown, others));
    }
    const profiles = shown[0]?.drawing.profiles || [];
    if (where("profile-legend")) {
      Figures.legend(where("profile-legend"), profiles.some(({ beside }) => beside) ? [...entries, { label: "plant", colour: "plant", dash: true }] : entries);
    }
    for (const { key, label } of profiles) {
      add("profiles", label, false, (node) => Figures.overSoc(node, key, shown, others));
    }
    const marked = shown.map(({ label, colour, number }) => ({ label, colour, row: rows.find((row) => row.number === number) }));
    add("convergence", Figures.ofConvergence(head), true, (node) => Figures.convergence(node, head, rows, marked));
    if (importance && where("importance")) {
      const more = [
        importance.left_out ? `; ${importance.left_out} smaller ones left out` : "",
        importance.unscored.length ? `; without a score, since a limit ended the episode or it failed: ${importance.unscored.join(", ")}` : "",
      ].join("");
      add("importance", `objective lost when an entry is put back${more}`, false, (node) => Figures.losses(node, importance));
    }
    if (rows.some((row) => row.status !== "running")) {
      add("parallel", "theta of every trial (parallel coordinates)", true, (node) => Figures.parallel(node, head, rows, marked));
      const over = Slices(where, () => sliced());
      const node = Figures.place(where("slices"), "each trial over one entry of theta");
      const sliced = () => Figures.slice(node, head, rows, over(head, rows), marked);
      redraw.push(sliced);
    }
    if (studies && where("studies")) add("studies", "the studies of this store with the same objective", false, (node) => Figures.courses(node, studies));
    for (const { caption, unit, step, down, up, names } of sensitivity) {
      add("sensitivity", caption, false, (node) => Figures.bars(node, names, down, up, unit, step));
    }
    for (const draw of redraw) await draw();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => redraw.forEach((draw) => draw()));
    note.remove();
    document.documentElement.dataset.drawn = "yes";
  } catch (error) {
    note.textContent = `The figures cannot be drawn in this browser (${error}). It must know DecompressionStream, as all do since 2023.`;
    note.className = "bad";
  }
})();
