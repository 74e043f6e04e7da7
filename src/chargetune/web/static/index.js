"use strict";
// The list of studies, renewed whenever the store changes. All text goes in as text, never as markup.
const state = document.getElementById("state");

function cell(content, kind = "") {
  const node = document.createElement("td");
  node.className = kind;
  node.append(content ?? "-");
  return node;
}

function line(study) {
  const row = document.createElement("tr"), link = document.createElement("a");
  link.href = `/studies/${study.id}`;
  link.textContent = study.name;
  row.append(
    cell(link, "text"), cell(String(study.done)), cell(String(study.running)), cell(String(study.failed)), cell(String(study.violating)),
    cell(study.best === null ? "-" : String(study.best)), cell(study.best_objective || "-", "text"), cell(study.tuner || "-", "text"),
    cell(study.told_at ? study.told_at.slice(0, 19).replace("T", " ") : "-", "text"),
  );
  return row;
}

const source = new EventSource("/stream");
source.addEventListener("studies", (event) => {
  const { studies } = JSON.parse(event.data);
  document.getElementById("studies").replaceChildren(...studies.map(line).reverse());
  state.textContent = studies.length ? "live" : "live; the store has no studies yet";
  state.className = "faint";
});
source.addEventListener("trouble", (event) => {
  state.textContent = JSON.parse(event.data).message;
  state.className = "bad";
});
source.onerror = () => {
  // A browser tries again by itself unless it was refused.
  const refused = source.readyState === EventSource.CLOSED;
  state.textContent = refused ? "the server refuses; load the page again" : "no connection to the server, trying again";
  state.className = "bad";
};
