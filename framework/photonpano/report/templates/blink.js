"use strict";
// Show panoramas at one place, one after the other, so that differences blink. Without it they stand one below the other.
(() => {
  const place = document.getElementById("blink"), figures = [...place.querySelectorAll("figure")];
  const PERIOD_MS = 600;
  let shown = 0, timer = 0;

  function show(index) {
    shown = index;
    figures.forEach((figure, k) => { figure.hidden = k !== index; });
    buttons.forEach((button, k) => button.setAttribute("aria-pressed", k === index));
  }

  function play(running) {
    clearInterval(timer);
    timer = running ? setInterval(() => show((shown + 1) % figures.length), PERIOD_MS) : 0;
    blink.textContent = running ? "Stop" : "Blink";
  }

  function button(label, action) {
    const made = document.createElement("button");
    made.type = "button";
    made.textContent = label;
    made.addEventListener("click", action);
    return made;
  }

  const buttons = figures.map((figure, k) => button(figure.querySelector("figcaption").textContent, () => { play(false); show(k); }));
  const blink = button("Blink", () => play(!timer));
  const row = document.createElement("div");
  row.className = "row";
  row.append(blink, ...buttons);
  place.before(row);
  show(0);
})();
