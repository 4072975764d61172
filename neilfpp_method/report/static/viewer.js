"use strict";
(() => {
  const block = document.getElementById("surface-data");
  if (!block) return;
  const canvas = document.getElementById("surface-canvas"), status = document.getElementById("surface-status");
  const gl = canvas.getContext("webgl2", { antialias: true, alpha: true });
  if (!gl) {
    status.textContent = "This browser does not support WebGL 2, so the surface cannot be drawn here. neilfpp export writes it to a file.";
    return;
  }
  const data = JSON.parse(block.textContent);
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const vertex = `#version 300 es
    in vec3 position, normal, color; in vec2 material; uniform mat4 all; uniform vec3 low, high;
    out vec3 place, n, c; out vec2 m;
    void main() { place = mix(low, high, position); n = normal; c = color; m = material; gl_Position = all * vec4(place, 1.0); }`;
  // "lit" is a preview under a light at the camera and a grey sky; it does not use the light of the run.
  const fragment = `#version 300 es
    precision highp float; in vec3 place, n, c; in vec2 m; uniform vec3 eye; uniform int layer; out vec4 shown;
    void main() {
      vec3 v = normalize(eye - place), normal = normalize(n); if (dot(normal, v) < 0.0) normal = -normal;
      vec3 base = layer == 5 ? vec3(0.5) : pow(c, vec3(2.2)); float rough = layer == 5 ? 1.0 : max(m.x, 0.08), metal = layer == 5 ? 0.0 : m.y;
      vec3 l = normalize(v + 0.6 * normalize(cross(v, vec3(0.01, 0.0, 1.0))) + vec3(0.0, 0.0, 0.5)), h = normalize(l + v);
      float nl = max(dot(normal, l), 0.0), nv = max(dot(normal, v), 0.001), nh = max(dot(normal, h), 0.0), a = rough * rough;
      float d = nh * nh * (a * a - 1.0) + 1.0, k = a / 2.0, ggx = a * a / (3.1416 * d * d) / (4.0 * (nl * (1.0 - k) + k) * (nv * (1.0 - k) + k));
      vec3 f0 = mix(vec3(0.04), base, metal), f = f0 + (1.0 - f0) * pow(1.0 - max(dot(h, v), 0.0), 5.0);
      vec3 lit = 2.2 * nl * (base * (1.0 - metal) / 3.1416 + f * ggx) * 1.4 + (0.35 + 0.25 * normal.z) * mix(base, f0, metal);
      vec3 values[6] = vec3[6](pow(lit, vec3(1.0 / 2.2)), c, vec3(m.x), vec3(m.y), 0.5 * (normalize(n) + 1.0), pow(lit, vec3(1.0 / 2.2)));
      shown = vec4(values[layer], 1.0);
    }`;
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source); gl.compileShader(shader); gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
    status.textContent = `The surface cannot be drawn here: ${gl.getProgramInfoLog(program)}`;
    return;
  }
  gl.useProgram(program);
  function attribute(name, text, type, size) {
    const at = gl.getAttribLocation(program, name);
    if (!text || at < 0) return;
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, bytes(text), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, size, type, true, 0, 0);
  }
  attribute("position", data.position, gl.UNSIGNED_SHORT, 3);
  attribute("normal", data.normal, gl.BYTE, 3);
  attribute("color", data.color, gl.UNSIGNED_BYTE, 3);
  attribute("material", data.material, gl.UNSIGNED_BYTE, 2);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, bytes(data.index), gl.STATIC_DRAW);
  const place = (name) => gl.getUniformLocation(program, name);
  const centre = data.low.map((low, i) => (low + data.high[i]) / 2);
  const radius = Math.hypot(...data.low.map((low, i) => data.high[i] - low)) / 2;
  const start = { turn: 0.6, lift: 0.45, far: 2.7 };
  let state = { ...start }, turning = !matchMedia("(prefers-reduced-motion: reduce)").matches, visible = false, scheduled = false;

  const minus = (a, b) => a.map((x, i) => x - b[i]), dot = (a, b) => a.reduce((s, x, i) => s + x * b[i], 0);
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unit = (a) => a.map((x) => x / Math.hypot(...a));
  function draw() {
    scheduled = false;
    const ratio = Math.min(devicePixelRatio || 1, 2), width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    const far = state.far * radius, { turn, lift } = state;
    const eye = [Math.cos(turn) * Math.cos(lift), Math.sin(turn) * Math.cos(lift), Math.sin(lift)].map((x, i) => centre[i] + far * x);
    const back = unit(minus(eye, centre)), right = unit(cross([0, 0, 1], back)), up = cross(back, right);
    const f = 2.4 * Math.min(1, width / height), near = Math.max(far - 1.1 * radius, 0.02 * radius), end = far + 1.1 * radius;
    const a = (end + near) / (near - end), b = 2 * end * near / (near - end), view = [right, up, back], all = new Float32Array(16);
    for (let column = 0; column < 4; column++) {
      const [x, y, z] = view.map((axis) => column < 3 ? axis[column] : -dot(axis, eye));
      all.set([f * height / width * x, f * y, a * z + (column === 3 ? b : 0), -z], 4 * column);
    }
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT); gl.enable(gl.DEPTH_TEST);
    gl.uniformMatrix4fv(place("all"), false, all);
    gl.uniform3fv(place("low"), data.low); gl.uniform3fv(place("high"), data.high); gl.uniform3fv(place("eye"), eye);
    gl.uniform1i(place("layer"), +document.querySelector("input[name=surface-layer]:checked").value);
    gl.drawElements(gl.TRIANGLES, 3 * data.faces, gl.UNSIGNED_INT, 0);
    if (turning && visible) { state.turn += 0.006; schedule(); }
  }
  function schedule() { if (!scheduled) { scheduled = true; requestAnimationFrame(draw); } }
  const pause = document.getElementById("surface-pause");
  function turn(on) { turning = on; pause.textContent = on ? "Stop rotation" : "Rotate"; schedule(); }
  function move(turned, lifted, zoom = 1) {
    state.turn += turned;
    state.lift = Math.min(1.5, Math.max(-1.5, state.lift + lifted));
    state.far = Math.min(8, Math.max(1.2, state.far * zoom));
    turn(false);
  }
  canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
  canvas.addEventListener("pointermove", (event) => { if (event.buttons) move(-0.008 * event.movementX, 0.008 * event.movementY); });
  canvas.addEventListener("wheel", (event) => {
    // Until the canvas has the focus, the wheel scrolls the page.
    if (!event.ctrlKey && document.activeElement !== canvas) return;
    event.preventDefault();
    move(0, 0, Math.exp(0.001 * event.deltaY));
  }, { passive: false });
  const keys = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1], "+": [0, 0, 0.9], "-": [0, 0, 1.1] };
  canvas.addEventListener("keydown", (event) => { if (keys[event.key]) { event.preventDefault(); move(...keys[event.key]); } });
  document.getElementById("surface").addEventListener("change", schedule);
  pause.addEventListener("click", () => turn(!turning));
  document.getElementById("surface-reset").addEventListener("click", () => { state = { ...start }; schedule(); });
  new ResizeObserver(schedule).observe(canvas);
  new IntersectionObserver((entries) => { visible = entries[0].isIntersecting; schedule(); }).observe(canvas);
  turn(turning);
  status.textContent = `${data.faces.toLocaleString("en")} triangles. Drag or press the arrow keys to rotate; press + or − to zoom.`;
})();
