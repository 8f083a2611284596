"use strict";
// Look around in a panorama on a sphere, or of a full turn: each pixel of a canvas is a ray of a camera that turns, with straight
// lines as they are. Rays are x right, y down, z ahead; `across` and `down` are the coordinates of the panorama's borders,
// in radians, as its projection has them. Returns null where the browser has no WebGL.
function sphereViewer(canvas, { projection, across: [first, last], down: [low, high] }) {
  const gl = canvas.getContext("webgl2");
  if (!gl) return null;
  const TURN = 2 * Math.PI, WIDEST = 120, NARROWEST = 5, USUAL = 75; // the field of view, in degrees along the longer side
  const fullTurn = last - first > TURN - 1e-6;
  // In GLSL, the coordinate of a ray down the panorama; and the angle of elevation that has such a coordinate.
  const [coordinate, elevation] = {
    spherical: ["atan(ray.y, length(ray.xz))", (b) => b],
    cylindrical: ["ray.y / length(ray.xz)", Math.atan],
    mercator: ["asinh(ray.y / length(ray.xz))", (b) => Math.atan(Math.sinh(b))],
  }[projection];
  const [highest, lowest] = [elevation(low), elevation(high)]; // negative is up
  const state = { yaw: 0, pitch: 0, view: 0 };
  let waiting = false;

  function compiled(type, source) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, `#version 300 es\nprecision highp float;\n${source}`);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }

  const program = gl.createProgram();
  // One triangle that holds the whole window.
  compiled(gl.VERTEX_SHADER, "void main() { gl_Position = vec4(4 * (gl_VertexID & 1) - 1, 2 * (gl_VertexID & 2) - 1, 0, 1); }");
  compiled(gl.FRAGMENT_SHADER, `
    uniform sampler2D panorama;
    uniform mat3 turn;
    uniform vec2 size, low, span; // size: of the window, in pixels
    uniform float focal; // pixels
    out vec4 colour;
    void main() {
      vec2 beside = gl_FragCoord.xy - size / 2.0;
      vec3 ray = turn * vec3(beside.x, -beside.y, focal);
      vec2 at = vec2(atan(ray.x, ray.z), ${coordinate}) - low;
      at.x -= ${TURN} * floor(at.x / ${TURN});
      at /= span;
      bool inside = at.y >= 0.0 && at.y <= 1.0 && (at.x <= 1.0 || ${fullTurn});
      colour = vec4(inside ? textureLod(panorama, at, 0.0).rgb : vec3(0), 1); // dark where no panorama is
    }`);
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) return null;
  gl.useProgram(program);
  const uniform = (name) => gl.getUniformLocation(program, name);
  gl.uniform2f(uniform("low"), first, low);
  gl.uniform2f(uniform("span"), last - first, high - low);
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  // The last column of a full turn is beside the first.
  const settings = { WRAP_S: fullTurn ? "REPEAT" : "CLAMP_TO_EDGE", WRAP_T: "CLAMP_TO_EDGE", MIN_FILTER: "LINEAR", MAG_FILTER: "LINEAR" };
  for (const [name, value] of Object.entries(settings)) gl.texParameteri(gl.TEXTURE_2D, gl[`TEXTURE_${name}`], gl[value]);

  function focal(width, height) {
    return Math.max(width, height) / 2 / Math.tan(state.view / 2 * Math.PI / 180);
  }

  function draw() {
    waiting = false;
    const { width, height } = canvas, [sa, ca] = [Math.sin(state.yaw), Math.cos(state.yaw)];
    const [sb, cb] = [Math.sin(state.pitch), Math.cos(state.pitch)];
    gl.viewport(0, 0, width, height);
    gl.uniform2f(uniform("size"), width, height);
    gl.uniform1f(uniform("focal"), focal(width, height));
    gl.uniformMatrix3fv(uniform("turn"), false, [ca, 0, -sa, -sa * sb, cb, -ca * sb, sa * cb, sb, ca * cb]); // right, down, ahead
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  function redraw() {
    if (!waiting) requestAnimationFrame(draw);
    waiting = true;
  }

  // Look at what the panorama holds, and not beside it.
  function look(yaw, pitch) {
    state.yaw = fullTurn ? yaw % TURN : Math.min(last, Math.max(first, yaw));
    state.pitch = Math.min(lowest, Math.max(highest, pitch));
    redraw();
  }

  function move(dx, dy) { // in pixels of the page
    const scale = focal(canvas.clientWidth, canvas.clientHeight);
    look(state.yaw - dx / scale / Math.max(0.25, Math.cos(state.pitch)), state.pitch - dy / scale);
  }

  function zoom(factor) {
    state.view = Math.min(WIDEST, Math.max(NARROWEST, state.view / factor));
    redraw();
  }

  function fit() {
    state.view = USUAL;
    look((first + last) / 2, (highest + lowest) / 2);
  }

  function resize() {
    const ratio = window.devicePixelRatio || 1;
    canvas.style.height = `${Math.min(640, Math.max(260, 0.6 * canvas.clientWidth))}px`;
    canvas.width = Math.round(canvas.clientWidth * ratio);
    canvas.height = Math.round(canvas.clientHeight * ratio);
    draw(); // at once: a canvas of another size is empty
  }

  function show(picture) {
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, picture);
    redraw();
  }

  fit();
  return { canvas, state, longest: gl.getParameter(gl.MAX_TEXTURE_SIZE), move, zoom, fit, look, resize, show };
}
