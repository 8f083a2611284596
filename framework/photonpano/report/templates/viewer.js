"use strict";
// The viewer of a report: pan and zoom, exposure, maps, the path over the frames, and pictures to compare.
// A browser without it shows the pictures of the page as they are.
(() => {
  const place = document.getElementById("viewer");
  const data = JSON.parse(document.getElementById("viewer-data").textContent);
  const [width, height] = data.size; // of the panorama, in its pixels
  const MAX_SCALE = 32, MAP_OPACITY = 0.65;

  function element(name, attributes, ...children) {
    const made = document.createElement(name);
    for (const [key, value] of Object.entries(attributes || {})) made.setAttribute(key, value);
    made.append(...children);
    return made;
  }

  function number(value) {
    return value.toLocaleString("en", { maximumSignificantDigits: 3 });
  }

  function picture(uri) {
    return new Promise((resolve, reject) => {
      const image = new Image();
      image.onload = () => resolve(image);
      image.onerror = reject;
      image.src = uri;
    });
  }

  // ---- linear data: codes of 12 bits, logarithmic in the flux; 0 is a pixel that was not seen ----

  async function codesOf(linear) {
    const packed = Uint8Array.from(atob(linear.data), (letter) => letter.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
    const codes = new Uint16Array(bytes.length / 2);
    for (let k = 0; k < codes.length; k++) codes[k] = 256 * bytes[k] + bytes[codes.length + k];
    return codes;
  }

  function fluxOf(code) {
    const { low, high, codes } = data.linear;
    return low * Math.pow(high / low, (code - 1) / (codes - 1));
  }

  // Show the codes on a canvas, so that `white` photons per pixel per frame are white, with the sRGB curve.
  function develop(canvas, codes, white) {
    const shade = new Uint8Array(data.linear.codes + 1);
    for (let code = 1; code < shade.length; code++) {
      const light = Math.min(1, fluxOf(code) / white);
      shade[code] = 255 * (light > 0.0031308 ? 1.055 * Math.pow(light, 1 / 2.4) - 0.055 : 12.92 * light) + 0.5;
    }
    const channels = data.linear.channels, context = canvas.getContext("2d");
    const image = context.createImageData(canvas.width, canvas.height), pixels = image.data;
    for (let pixel = 0, k = 0; pixel < pixels.length; pixel += 4, k += channels) {
      pixels[pixel] = shade[codes[k]];
      pixels[pixel + 1] = channels === 3 ? shade[codes[k + 1]] : pixels[pixel];
      pixels[pixel + 2] = channels === 3 ? shade[codes[k + 2]] : pixels[pixel];
      pixels[pixel + 3] = 255;
    }
    context.putImageData(image, 0, 0);
  }

  // ---- the panorama: pan, zoom, and what is drawn over it ----

  // Move and zoom a canvas with the mouse, with fingers, and with keys.
  function gestures(canvas, { zoom, move, fit }) {
    const pointers = new Map();
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
    });
    for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (event) => pointers.delete(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId), now = [event.offsetX, event.offsetY];
      if (!before) return;
      pointers.set(event.pointerId, now);
      const other = [...pointers].find(([id]) => id !== event.pointerId);
      if (other) {
        const [x, y] = other[1];
        zoom(Math.hypot(now[0] - x, now[1] - y) / Math.max(1, Math.hypot(before[0] - x, before[1] - y)), x, y);
      } else move(now[0] - before[0], now[1] - before[1]);
    });
    canvas.addEventListener("wheel", (event) => {
      if (document.activeElement !== canvas && !event.ctrlKey) return; // the wheel scrolls the page until the panorama is clicked
      event.preventDefault();
      zoom(Math.pow(1.002, -event.deltaY), event.offsetX, event.offsetY);
    }, { passive: false });
    canvas.addEventListener("dblclick", (event) => zoom(2, event.offsetX, event.offsetY));
    const keys = {
      "+": () => zoom(1.5), "-": () => zoom(1 / 1.5), 0: fit,
      ArrowLeft: () => move(60, 0), ArrowRight: () => move(-60, 0), ArrowUp: () => move(0, 60), ArrowDown: () => move(0, -60),
    };
    canvas.addEventListener("keydown", (event) => {
      if (!(event.key in keys) || event.ctrlKey || event.metaKey) return;
      event.preventDefault();
      keys[event.key]();
    });
  }

  function panoramaViewer(codes, picture) {
    const canvas = element("canvas", { tabindex: 0, role: "application", "aria-label": "The panorama: drag to move, + and - to zoom" });
    const context = canvas.getContext("2d");
    const flat = element("canvas"), developed = element("canvas", { width: data.linear.width, height: data.linear.height });
    const state = { scale: 1, x: 0, y: 0, map: null, instant: 0, path: true, fitted: true, around: null, shown: picture || developed };
    const style = getComputedStyle(document.documentElement);
    let waiting = false;

    function line(context, points, pixel) {
      context.beginPath();
      points.forEach(([x, y], k) => {
        const jumps = data.path.wide && k > 0 && Math.abs(x - points[k - 1][0]) > width / 2; // over the seam of a full turn
        if (k === 0 || jumps) context.moveTo(x + 0.5, y + 0.5);
        else context.lineTo(x + 0.5, y + 0.5);
      });
      for (const [colour, thickness] of [["#000", 3.5], [style.getPropertyValue("--path").trim(), 1.8]]) {
        context.strokeStyle = colour;
        context.lineWidth = thickness * pixel;
        context.stroke();
      }
    }

    // Draw all that is shown; `pixel` is a pixel of the page, in those of the panorama.
    function paint(context, pixel) {
      context.drawImage(state.shown, 0, 0, width, height);
      if (state.map) {
        const [left, top, right, bottom] = state.map.box;
        context.globalAlpha = MAP_OPACITY;
        context.imageSmoothingEnabled = false;
        context.drawImage(state.map.image, left, top, right - left, bottom - top);
        context.globalAlpha = 1;
      }
      if (state.path) {
        line(context, data.path.centres, pixel);
        line(context, data.path.outlines[state.instant], pixel);
      }
    }

    // What is shown, as a picture to look around in.
    function painted(longest) {
      const { width: columns, height: rows } = state.shown, scale = Math.min(1, longest / columns, longest / rows);
      flat.width = Math.round(columns * scale); // which clears it
      flat.height = Math.round(rows * scale);
      const context = flat.getContext("2d");
      context.scale(flat.width / width, flat.height / height);
      paint(context, 0.5 * width / flat.width); // it will be enlarged, and its lines with it
      return flat;
    }

    function draw() {
      waiting = false;
      if (state.around) return state.around.show(painted(state.around.longest));
      const ratio = canvas.width / canvas.clientWidth, scale = ratio * state.scale;
      context.setTransform(1, 0, 0, 1, 0, 0);
      context.clearRect(0, 0, canvas.width, canvas.height);
      context.setTransform(scale, 0, 0, scale, ratio * state.x, ratio * state.y);
      context.imageSmoothingEnabled = scale * width / state.shown.width < 3;
      paint(context, 1 / state.scale);
    }

    function redraw() {
      if (!waiting) requestAnimationFrame(draw);
      waiting = true;
    }

    function leastScale() {
      return Math.min(canvas.clientWidth / width, canvas.clientHeight / height);
    }

    // Keep the panorama in the window, and in its middle where it is smaller.
    function settle() {
      for (const [side, room, size] of [["x", canvas.clientWidth, width], ["y", canvas.clientHeight, height]]) {
        const free = room - size * state.scale;
        state[side] = free > 0 ? free / 2 : Math.min(0, Math.max(free, state[side]));
      }
      canvas.style.touchAction = state.fitted ? "pan-y" : "none"; // a finger scrolls the page until the panorama is zoomed
      redraw();
    }

    function zoom(factor, x = canvas.clientWidth / 2, y = canvas.clientHeight / 2) {
      const least = leastScale(), scale = Math.min(MAX_SCALE, Math.max(least, state.scale * factor));
      state.x = x - (x - state.x) * scale / state.scale;
      state.y = y - (y - state.y) * scale / state.scale;
      state.scale = scale;
      state.fitted = scale <= least * 1.001;
      settle();
    }

    function move(dx, dy) {
      state.x += dx;
      state.y += dy;
      settle();
    }

    function fit() {
      state.scale = leastScale();
      state.fitted = true;
      settle();
    }

    function resize() {
      if (state.around) return state.around.resize();
      const ratio = window.devicePixelRatio || 1;
      canvas.style.height = `${Math.min(640, Math.max(200, canvas.clientWidth * height / width))}px`;
      canvas.width = Math.round(canvas.clientWidth * ratio);
      canvas.height = Math.round(canvas.clientHeight * ratio);
      if (state.fitted) fit();
      else settle();
      draw(); // at once: a canvas of another size is empty
    }

    gestures(canvas, { zoom, move, fit });

    function fluxAt(event) {
      const x = Math.floor((event.offsetX - state.x) / state.scale), y = Math.floor((event.offsetY - state.y) / state.scale);
      if (x < 0 || y < 0 || x >= width || y >= height) return "";
      const { width: columns, height: rows, channels } = data.linear;
      const first = channels * (Math.floor((y + 0.5) * rows / height) * columns + Math.floor((x + 0.5) * columns / width));
      const found = [...codes.subarray(first, first + channels)];
      const flux = found.every((code) => code === 0) ? "not seen" : found.map((code) => number(fluxOf(code))).join(", ");
      return `x ${x}, y ${y}: ${flux}`;
    }

    function expose(stops) {
      develop(developed, codes, data.linear.white / Math.pow(2, stops));
      state.shown = developed;
      redraw();
    }

    if (!picture) expose(0);
    return { canvas, state, redraw, resize, zoom, fit, fluxAt, expose };
  }

  function button(label, title, action) {
    const made = element("button", { type: "button", title }, label);
    made.addEventListener("click", action);
    return made;
  }

  function slider(label, attributes, action) {
    const input = element("input", { type: "range", ...attributes }), output = element("output");
    const update = () => { output.textContent = action(Number(input.value)); };
    input.addEventListener("input", update);
    update();
    return { input, update, row: element("label", { class: "slider" }, element("span", {}, label), input, output) };
  }

  function choice(label, names, action, first = 0) {
    const select = element("select", { "aria-label": label }, ...names.map((name, k) => element("option", { value: k }, name)));
    select.value = first;
    select.addEventListener("change", () => action(Number(select.value)));
    return select;
  }

  function legend(map) {
    const bar = element("span", { class: "bar" });
    bar.style.background = `linear-gradient(to right, ${map.colours.join(", ")})`;
    return [`${number(map.low)} `, bar, ` ${number(map.high)} ${map.unit}`];
  }

  function controls(viewer) {
    const readout = element("span", { class: "readout" }), key = element("span", { class: "legend" });
    viewer.canvas.addEventListener("pointermove", (event) => { readout.textContent = viewer.fluxAt(event); });
    const toned = data.picture !== null;
    let touched = !toned;
    const exposure = slider("Exposure", { min: -6, max: 6, step: 0.1, value: 0, "aria-label": "Exposure in stops" }, (stops) => {
      if (touched) viewer.expose(stops);
      touched = true;
      return `${stops > 0 ? "+" : ""}${stops.toFixed(1)} stops; white is ${number(data.linear.white / Math.pow(2, stops))}`;
    });
    exposure.input.addEventListener("dblclick", () => { exposure.input.value = 0; exposure.update(); });
    const showMap = (index) => {
      viewer.state.map = index ? data.maps[index - 1] : null;
      key.replaceChildren(...(index ? legend(data.maps[index - 1]) : []));
      viewer.redraw();
    };
    const path = element("input", { type: "checkbox", checked: "" });
    path.addEventListener("change", () => { viewer.state.path = path.checked; viewer.redraw(); });
    const now = () => viewer.state.around || viewer;
    const pixels = button("1:1", "One pixel of the panorama to one of the screen", () => viewer.zoom(1 / viewer.state.scale));
    return element("div", { class: "controls" },
      element("div", { class: "row" },
        button("+", "Zoom in", () => now().zoom(1.5)), button("\u2212", "Zoom out", () => now().zoom(1 / 1.5)),
        button("Fit", "Show all of the panorama, or look ahead", () => now().fit()), pixels,
        ...(data.angles ? lookAround(viewer, pixels) : []),
        choice("Map over the panorama", ["No map", ...data.maps.map((map) => map.name)], showMap), key,
        element("label", {}, path, " path")),
      exposure.row, scrubber(viewer), element("p", { class: "muted" }, readout));
  }

  // A button that turns the flat panorama into a view from its middle, and back; and what it says where that is impossible.
  function lookAround(viewer, pixels) {
    const canvas = element("canvas", { tabindex: 0, role: "application", "aria-label": "A view into the panorama: drag to look around, + and - to zoom" });
    const note = element("span");
    let sphere;
    const around = button("Look around", "See the panorama from where the camera was, with straight lines", () => {
      if (sphere === undefined) {
        sphere = sphereViewer(canvas, data.angles);
        if (sphere === null) {
          around.disabled = true;
          note.textContent = "This browser has no WebGL 2, which looking around needs.";
          return;
        }
        gestures(canvas, sphere);
        canvas.style.touchAction = "none";
      }
      const back = viewer.state.around !== null, [from, to] = back ? [canvas, viewer.canvas] : [viewer.canvas, canvas];
      viewer.state.around = back ? null : sphere;
      from.replaceWith(to);
      around.setAttribute("aria-pressed", !back);
      pixels.disabled = !back;
      viewer.resize();
      viewer.redraw();
      to.focus({ preventScroll: true });
    });
    return [around, note];
  }

  // A slider over frames: where the frame lies on the panorama, when, and what the camera saw.
  function scrubber(viewer) {
    const { frames, std } = data.path, image = element("img", { class: "glimpse", alt: "What the camera saw" });
    const tint = element("img", { class: "tint", alt: "" }), share = element("span");
    const frame = slider("Frame", { min: 0, max: frames.length - 1, value: data.path.start, "aria-label": "Frame" }, (index) => {
      viewer.state.instant = index;
      viewer.redraw();
      const now = frames[index];
      const nearest = data.glimpses.reduce((best, each) => Math.abs(each.frame - now) < Math.abs(best.frame - now) ? each : best);
      if (image.getAttribute("src") !== nearest.uri) image.src = nearest.uri;
      image.title = `The sum of frames ${nearest.first} to ${nearest.last}`;
      if (data.tint) {
        tint.src = nearest.tint;
        share.textContent = `${Math.round(100 * nearest.hidden)} % of this picture hides the background; left out of the motion`;
      }
      const seconds = now / data.rate, time = data.rate ? `, ${seconds < 1 ? `${number(1000 * seconds)} ms` : `${number(seconds)} s`}` : "";
      const error = std[index] === null ? "not located" : `expected error ${number(std[index])} px`;
      return `${now.toLocaleString("en")}${time}: ${error}`;
    });
    let playing = 0;
    const play = button("Play", "Play the frames", () => {
      if (playing) { clearInterval(playing); playing = 0; }
      else playing = setInterval(() => {
        const step = Math.max(1, Math.round(frames.length / 300));
        frame.input.value = (Number(frame.input.value) + step) % frames.length;
        frame.update();
      }, 33);
      play.textContent = playing ? "Stop" : "Play";
    });
    frame.row.prepend(play);
    const side = element("div", {}, frame.row), seen = element("div", { class: "seen" }, image);
    if (data.tint) {
      const swatch = element("span", { class: "swatch", style: `background: ${data.tint}` });
      const hidden = element("input", { type: "checkbox", checked: "" });
      hidden.addEventListener("change", () => { tint.hidden = !hidden.checked; });
      side.append(element("label", { class: "hidden-parts" }, hidden, " ", swatch, " hidden parts: ", share));
      seen.append(tint);
    }
    return element("div", { class: "scrubber" }, side, seen);
  }

  // Two pictures of one instant, one over the other, with a divider to drag.
  function comparison() {
    const views = data.views, last = views.length - 1;
    const images = [element("img", {}), element("img", { class: "over" })], notes = [element("span"), element("span")];
    const show = (side, index) => {
      images[side].src = views[index].uri;
      images[side].alt = views[index].name;
      notes[side].textContent = views[index].note;
    };
    const stack = element("div", { class: "stack" }, images[1], images[0]);
    const place = slider("Divider", { min: 0, max: 100, step: 0.1, value: 50, "aria-label": "Divider" }, (percent) => {
      stack.style.setProperty("--divider", `${percent}%`);
      return "";
    });
    const follow = (event) => {
      const box = stack.getBoundingClientRect();
      place.input.value = 100 * (event.clientX - box.left) / box.width;
      place.update();
    };
    stack.addEventListener("pointerdown", (event) => { stack.setPointerCapture(event.pointerId); follow(event); });
    stack.addEventListener("pointermove", (event) => { if (event.buttons) follow(event); });
    stack.addEventListener("dragstart", (event) => event.preventDefault());
    show(0, 0);
    show(1, last);
    const names = views.map((view) => view.name);
    return element("section", { id: "before-and-after" }, element("h2", {}, "Before and after"),
      element("p", {}, `One instant, that of frame ${data.instant.toLocaleString("en")}, in the same light: drag over the picture to compare.`),
      element("div", { class: "row sides" },
        element("div", { class: "row" }, choice("Picture on the left", names, (index) => show(0, index), 0), notes[0]),
        element("div", { class: "row" }, notes[1], choice("Picture on the right", names, (index) => show(1, index), last))),
      stack, place.row);
  }

  async function start() {
    const [codes, toned, ...maps] = await Promise.all([
      codesOf(data.linear), data.picture === null ? null : picture(data.picture), ...data.maps.map((map) => picture(map.uri)),
    ]);
    data.maps.forEach((map, k) => { map.image = maps[k]; });
    const viewer = panoramaViewer(codes, toned), tools = controls(viewer);
    place.querySelector("img").replaceWith(viewer.canvas);
    viewer.canvas.after(tools);
    new ResizeObserver(viewer.resize).observe(viewer.canvas.parentElement);
    viewer.resize();
    document.querySelector(".numbers").after(comparison());
    place.classList.add("live");
  }

  if (typeof DecompressionStream !== "undefined") start();
})();
