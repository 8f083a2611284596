"use strict";
// Show a key exposure from beside its place: each pixel moves by its inverse depth, far ones first, so that near ones hide them.
(() => {
  const canvas = document.getElementById("depth"), slider = document.getElementById("viewpoint");
  const both = new Image();
  both.onload = () => {
    const width = both.width, height = both.height / 2, painted = canvas.getContext("2d", { willReadFrequently: true });
    canvas.width = width; canvas.height = both.height;
    painted.drawImage(both, 0, 0);
    const grey = painted.getImageData(0, 0, width, height).data, near = painted.getImageData(0, height, width, height).data;
    canvas.height = height;
    const known = [...Array(width * height).keys()].filter((k) => near[4 * k]).sort((a, b) => near[4 * a] - near[4 * b]);
    const colour = (level) => [Math.min(255, 2 * level), 255 - Math.abs(2 * level - 255), Math.min(255, 510 - 2 * level)];

    function paint() {
      const image = painted.createImageData(width, height), side = Number(slider.value), far = near[4 * known[known.length >> 1]];
      const inColours = document.getElementById("in-colours").checked;
      for (let k = 3; k < image.data.length; k += 4) image.data[k] = 255;
      for (const k of known) {
        const x = Math.round(k % width + side * (near[4 * k] - far) / 255 * 0.25 * width), row = k - k % width;
        if (x < 0 || x >= width - 1) continue;
        const shown = inColours ? colour(near[4 * k]) : [grey[4 * k], grey[4 * k], grey[4 * k]];
        image.data.set(shown, 4 * (row + x));
        image.data.set(shown, 4 * (row + x + 1));
      }
      painted.putImageData(image, 0, 0);
    }
    slider.addEventListener("input", paint);
    document.getElementById("in-colours").addEventListener("change", paint);
    paint();
  };
  both.src = canvas.dataset.source;
})();
