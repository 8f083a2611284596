"use strict";
// Click the same place in two pictures of frames, and save these pairs of points as the file that `graph.tie` takes.
(() => {
  const place = document.getElementById("ties"), height = Number(place.dataset.height), width = Number(place.dataset.width);
  const pictures = JSON.parse(document.getElementById("ties-data").textContent);
  const frames = pictures.map((each) => [each.frame, each.uri]).sort(([one], [other]) => one - other);
  if (frames.length < 2) {
    place.remove();
    return;
  }
  const ties = [];
  let waiting = null; // the point on the left whose other half is not clicked yet

  function element(name, attributes, ...children) {
    const made = document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    made.append(...children);
    return made;
  }

  function side(label, first, clicked) {
    const select = element("select", { "aria-label": label }, ...frames.map(([frame], k) => element("option", { value: k }, `around frame ${frame.toLocaleString("en")}`)));
    const image = element("img", { alt: label }), marks = element("div", { class: "marks" }, image);
    select.value = first;
    select.addEventListener("change", show);
    image.addEventListener("dragstart", (event) => event.preventDefault());
    image.addEventListener("click", (event) => {
      const box = image.getBoundingClientRect(); // integers are the middles of pixels
      clicked([(event.clientX - box.left) / box.width * width - 0.5, (event.clientY - box.top) / box.height * height - 0.5]);
      show();
    });
    return { select, image, marks, frame: () => frames[Number(select.value)][0] };
  }

  const left = side("Frame on the left", 0, (point) => { waiting = [left.frame(), ...point]; });
  const right = side("Frame on the right", frames.length - 1, (point) => {
    if (waiting && waiting[0] !== right.frame()) ties.push([...waiting, right.frame(), ...point]);
    waiting = null;
  });

  function text() {
    const lines = ties.map(([a, xa, ya, b, xb, yb]) => [a, xa.toFixed(1), ya.toFixed(1), b, xb.toFixed(1), yb.toFixed(1)].join(","));
    return ["frame_a,x_a,y_a,frame_b,x_b,y_b", ...lines, ""].join("\n");
  }

  function mark(x, y, label) {
    return element("span", { style: `left: ${100 * (x + 0.5) / width}%; top: ${100 * (y + 0.5) / height}%` }, label);
  }

  function show() {
    for (const each of [left, right]) {
      const uri = frames[Number(each.select.value)][1];
      if (each.image.getAttribute("src") !== uri) each.image.src = uri;
      const points = [...ties, ...(waiting ? [waiting] : [])].flatMap((tie, k) => [[...tie.slice(0, 3), k], [...tie.slice(3), k]]);
      each.marks.replaceChildren(each.image, ...points.filter(([frame]) => frame === each.frame()).map(([, x, y, k]) => mark(x, y, k + 1)));
    }
    table.textContent = text();
    save.disabled = undo.disabled = !ties.length;
  }

  const table = element("pre", {}), save = element("button", { type: "button" }, "Save ties.csv"), undo = element("button", { type: "button" }, "Undo");
  undo.addEventListener("click", () => { ties.pop(); show(); });
  save.addEventListener("click", () => {
    const url = URL.createObjectURL(new Blob([text()], { type: "text/csv" })), link = element("a", { href: url, download: "ties.csv" });
    link.click();
    URL.revokeObjectURL(url);
  });
  place.append(element("div", { class: "sides-by-side" }, ...[left, right].map((each) => element("div", {}, each.select, each.marks))), table, element("div", { class: "row" }, save, undo));
  show();
})();
