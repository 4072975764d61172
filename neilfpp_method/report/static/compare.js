"use strict";
(() => {
  const block = document.getElementById("views-data");
  if (!block) return;
  const data = JSON.parse(block.textContent);
  const stage = document.querySelector(".stage");
  const [before, after] = stage.querySelectorAll("img");
  const [left, right] = stage.querySelectorAll(".tag");
  const slider = stage.querySelector("input");
  const caption = document.getElementById("views-caption");
  const chosen = (name) => document.querySelector(`input[name=${name}]:checked`).value;
  const strips = [...document.querySelectorAll(".strip[data-view]")];

  function show() {
    const view = +chosen("view"), layer = +chosen("layer");
    const about = data.layers[layer], cell = about.cells[view];
    const beside = { truth: cell.truth, photograph: data.photographs[view], error: cell.error };
    for (const input of document.querySelectorAll("input[name=beside]")) input.disabled = !beside[input.value];
    let kind = chosen("beside");
    if (!beside[kind]) kind = "photograph";
    before.src = beside[kind];
    before.alt = `${about.title}, ${kind}, view ${data.names[view]}`;
    after.src = strips[view].querySelectorAll("img")[layer].src;
    after.alt = `${about.title}, estimate, view ${data.names[view]}`;
    left.textContent = kind;
    right.textContent = "estimate";
    const scale = kind === "error" ? ` The brightest error is ${about.largest} or more.` : "";
    caption.textContent = `${about.title} (${about.note}), view ${data.names[view]}: ${kind} on the left, estimate on the right.${scale}`;
    strips.forEach((strip, i) => { strip.hidden = i !== view; });
  }
  slider.addEventListener("input", () => stage.style.setProperty("--at", `${slider.value}%`));
  document.getElementById("views").addEventListener("change", show);
  show();
})();
