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
    const { title, note, largest, cells } = data.layers[layer], cell = cells[view];
    const pictures = { truth: cell.truth, photograph: data.photographs[view], error: cell.error };
    for (const input of document.querySelectorAll("input[name=beside]")) input.disabled = !pictures[input.value];
    let kind = chosen("beside");
    if (!pictures[kind]) kind = "photograph";
    before.src = pictures[kind];
    before.alt = `${title}, ${kind}, view ${data.names[view]}`;
    after.src = strips[view].querySelectorAll("img")[layer].src;
    after.alt = `${title}, estimate, view ${data.names[view]}`;
    left.textContent = kind;
    right.textContent = "estimate";
    const scale = kind === "error" ? ` The brightest colour is an error of ${largest} or more.` : "";
    caption.textContent = `${title} (${note}), view ${data.names[view]}: ${kind} on the left, estimate on the right.${scale}`;
    strips.forEach((strip, i) => { strip.hidden = i !== view; });
  }
  slider.addEventListener("input", () => stage.style.setProperty("--at", `${slider.value}%`));
  document.getElementById("views").addEventListener("change", show);
  show();
})();
