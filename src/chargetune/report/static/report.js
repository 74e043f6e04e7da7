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
    const { head, rows, shown, others, sensitivity } = JSON.parse(await unpack("data"));
    const where = (id) => document.getElementById(id);
    const redraw = [];
    const add = (id, caption, tall, draw) => {
      const node = Figures.place(where(id), caption, tall);
      redraw.push(() => draw(node));
    };
    const entries = shown.map(({ label, colour, dash }) => ({ label, colour, dash }));
    if (others.length) entries.push({ label: `trials (${others.length} shown)`, colour: "trials" });
    if (where("legend")) Figures.legend(where("legend"), [...entries, { label: "limit", colour: "limit", dash: true }]);
    const first = [...shown.map(({ drawing }) => drawing), ...others].find(({ panels }) => panels.length);
    for (const panel of first?.panels || []) {
      add("signals", panel.label, false, (node) => Figures.overTime(node, panel, shown, others));
    }
    for (const { key, label } of shown[0]?.drawing.profiles || []) {
      add("profiles", label, false, (node) => Figures.overSoc(node, key, shown, others));
    }
    const marked = shown.map(({ label, colour, number }) => ({ label, colour, row: rows.find((row) => row.number === number) }));
    add("convergence", "each trial, and the best so far", true, (node) => Figures.convergence(node, head, rows, marked));
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
