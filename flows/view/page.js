// One labelled scene of Gaussians, drawn by this page alone (WebGL2). Axes are those of SPZ: right, up, back.

const scene = JSON.parse(document.getElementById("scene").textContent);
const ROW = 1024; // Gaussians in a row of the texture, two texels each
const LEVELS = 1 << 16; // of depth, in sorting
const STEEPEST = 1.5; // radians above and below the horizon

async function unpacked(name) {
  const text = atob(document.getElementById(name).textContent.trim());
  const packed = Uint8Array.from(text, (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

// SPZ 3 without harmonics, as two texels a Gaussian: x, y, z, RGBA of 8 bits; rotation, scales of 8 bits, instance, 0.
function read(spz, instances) {
  const bytes = new Uint8Array(spz), header = new DataView(spz), count = header.getUint32(8, true);
  const unit = 2 ** -header.getUint8(13);
  const alphas = 16 + 9 * count, colors = alphas + count, scales = colors + 3 * count, rotations = scales + 3 * count;
  const places = new Float32Array(3 * count);
  for (let i = 0, at = 16; i < 3 * count; i++, at += 3)
    places[i] = (bytes[at] | (bytes[at + 1] << 8) | ((bytes[at + 2] << 24) >> 8)) * unit;
  const texels = new Uint32Array(8 * ROW * Math.ceil(count / ROW)), numbers = new Float32Array(texels.buffer);
  for (let i = 0; i < count; i++) {
    numbers.set(places.subarray(3 * i, 3 * i + 3), 8 * i);
    const c = colors + 3 * i, s = scales + 3 * i;
    texels[8 * i + 3] = bytes[c] | (bytes[c + 1] << 8) | (bytes[c + 2] << 16) | (bytes[alphas + i] << 24);
    texels[8 * i + 4] = header.getUint32(rotations + 4 * i, true);
    texels[8 * i + 5] = bytes[s] | (bytes[s + 1] << 8) | (bytes[s + 2] << 16);
    texels[8 * i + 6] = instances[i];
  }
  return { count, places, instances, texels };
}

const VERTEX = `#version 300 es
precision highp float; precision highp int; precision highp usampler2D;
uniform usampler2D texels, order; uniform sampler2D palette;
uniform mat3 axes; uniform vec3 eye; uniform vec2 viewport; uniform float focal;
uniform bool labelled; uniform int selected;
out vec4 tint; out vec2 place; flat out uint instance;

float component(uint bits) {
  float size = float(bits & 511u) / 511.0 * 0.70710678;
  return (bits & 512u) != 0u ? -size : size;
}

mat3 rotation(uint packed) {
  float found[3] = float[3](component(packed >> 20), component(packed >> 10), component(packed));
  float left = sqrt(max(0.0, 1.0 - found[0] * found[0] - found[1] * found[1] - found[2] * found[2]));
  int largest = int(packed >> 30), next = 0;
  float q[4];
  for (int i = 0; i < 4; i++) q[i] = i == largest ? left : found[next++];
  float x = q[0], y = q[1], z = q[2], w = q[3];
  return mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

vec4 bytes(uint word) { return vec4(word & 255u, (word >> 8) & 255u, (word >> 16) & 255u, word >> 24); }

void main() {
  int nth = gl_VertexID / 6, vertex = gl_VertexID - 6 * nth; // two triangles each: an instance each would cost a
  vertex = vertex > 2 ? 6 - vertex : vertex; // browser that draws on the processor five times as much
  vec2 corner = vec2(2 * (vertex & 1) - 1, 2 * (vertex >> 1) - 1);
  uint row = texelFetch(order, ivec2(nth % ${ROW}, nth / ${ROW}), 0).x;
  ivec2 at = ivec2(2u * (row % ${ROW}u), row / ${ROW}u);
  uvec4 first = texelFetch(texels, at, 0), second = texelFetch(texels, at + ivec2(1, 0), 0);
  vec3 p = axes * (uintBitsToFloat(first.xyz) - eye);
  vec4 rgba = bytes(first.w) / 255.0;
  tint = vec4(clamp(0.5 + 0.28209479 * (rgba.rgb - 0.5) / 0.15, 0.0, 1.0), rgba.a);
  instance = second.z;
  if (labelled) {
    vec3 own = texelFetch(palette, ivec2(int(instance) % 256, int(instance) / 256), 0).rgb;
    tint.rgb = own * (0.55 + 0.6 * dot(tint.rgb, vec3(0.299, 0.587, 0.114)));
  }
  if (int(instance) == selected) { // light and shade stay: a part of the way, blue would become the grey of a wall
    float light = dot(tint.rgb, vec3(0.299, 0.587, 0.114));
    tint.rgb = mix(tint.rgb, vec3(1.0, 0.62, 0.1) * (0.65 + 0.6 * light), 0.8);
  }

  mat3 turned = axes * rotation(second.x);
  vec3 s = exp(bytes(second.y).xyz / 16.0 - 10.0);
  mat3 half_axes = mat3(turned[0] * s.x, turned[1] * s.y, turned[2] * s.z);
  vec2 limit = 0.65 * viewport / focal; // 1.3 tan of half the field of view, as our rasterizer
  vec2 slope = clamp(p.xy / p.z, -limit, limit);
  vec3 along = vec3(1.0, 0.0, -slope.x) * half_axes, across = vec3(0.0, 1.0, -slope.y) * half_axes;
  float f = focal / p.z;
  float a = f * f * dot(along, along) + 0.3, b = f * f * dot(along, across), c = f * f * dot(across, across) + 0.3;
  float middle = 0.5 * (a + c), spread = length(vec2(0.5 * (a - c), b));
  vec2 axis = spread < 1e-6 ? vec2(1.0, 0.0) : normalize(abs(b) > 1e-6 ? vec2(b, middle + spread - a)
    : a > c ? vec2(1.0, 0.0) : vec2(0.0, 1.0));
  float reach = sqrt(2.0 * log(max(255.0 * tint.a, 1.0)));
  place = corner * reach;
  vec2 pixels = f * p.xy + place.x * sqrt(middle + spread) * axis
    + place.y * sqrt(max(middle - spread, 0.1)) * vec2(-axis.y, axis.x);
  gl_Position = vec4(2.0 * pixels / viewport * vec2(1.0, -1.0), 0.0, 1.0);
}`;

const FRAGMENT = `#version 300 es
precision highp float; precision highp int;
uniform bool picking;
in vec4 tint; in vec2 place; flat in uint instance;
out vec4 color;
void main() {
  float alpha = min(0.99, tint.a * exp(-0.5 * dot(place, place)));
  if (alpha < 1.0 / 255.0) discard;
  if (picking) {
    if (alpha < 0.3) discard;
    uint number = instance + 1u;
    color = vec4(number & 255u, (number >> 8) & 255u, number >> 16, 255u) / 255.0;
  } else color = vec4(tint.rgb * alpha, alpha);
}`;

class Splats {
  constructor(canvas, { count, places, instances, texels }) {
    Object.assign(this, { canvas, count, places, instances });
    this.shown = new Uint8Array(1 << 16).fill(1); // by instance
    this.labelled = false;
    this.selected = -1;
    this.rows = new Uint32Array(count);
    this.order = new Uint32Array(ROW * Math.ceil(count / ROW));
    this.depths = new Float32Array(count);
    this.drawn = 0;
    const gl = (this.gl = canvas.getContext("webgl2", { antialias: false, alpha: false }));
    if (!gl) throw new Error("This browser has no WebGL 2, which draws the scene.");
    this.program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(this.program, shader);
    }
    gl.linkProgram(this.program);
    if (!gl.getProgramParameter(this.program, gl.LINK_STATUS))
      throw new Error(`The scene cannot be drawn: ${gl.getProgramInfoLog(this.program)}`);
    gl.useProgram(this.program);
    this.texture(0, "texels", gl.RGBA32UI, 2 * ROW, gl.RGBA_INTEGER, gl.UNSIGNED_INT, texels);
    this.texture(1, "palette", gl.RGBA8, 256, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(scene.palette));
    this.texture(2, "order", gl.R32UI, ROW, gl.RED_INTEGER, gl.UNSIGNED_INT, this.order); // stays the active one
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }

  texture(unit, name, inner, width, format, type, content) {
    const gl = this.gl, height = content.length / (format === gl.RED_INTEGER ? 1 : 4) / width;
    if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error("The scene is too large for this graphics card.");
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, inner, width, height, 0, format, type, content);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    gl.uniform1i(this.uniform(name), unit);
  }

  uniform(name) { return this.gl.getUniformLocation(this.program, name); }

  // Those that are shown and lie ahead, the farthest first: a counting sort by depth.
  sort({ eye, forward, near }) {
    const { places, instances, shown, rows, order, depths } = this;
    let n = 0, low = Infinity, high = 0;
    for (let i = 0, k = 0; i < this.count; i++, k += 3) {
      if (!shown[instances[i]]) continue;
      const depth = (places[k] - eye[0]) * forward[0] + (places[k + 1] - eye[1]) * forward[1]
        + (places[k + 2] - eye[2]) * forward[2];
      if (depth < near) continue;
      depths[n] = depth;
      rows[n++] = i;
      if (depth < low) low = depth;
      if (depth > high) high = depth;
    }
    const first = new Uint32Array(LEVELS + 1), scale = (LEVELS - 1) / Math.max(high - low, 1e-12);
    for (let j = 0; j < n; j++) first[1 + (((high - depths[j]) * scale) | 0)]++;
    for (let level = 0; level < LEVELS; level++) first[level + 1] += first[level];
    for (let j = 0; j < n; j++) order[first[((high - depths[j]) * scale) | 0]++] = rows[j];
    const gl = this.gl;
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROW, Math.ceil(n / ROW), gl.RED_INTEGER, gl.UNSIGNED_INT, order);
    this.drawn = n;
  }

  draw(view, picking = false) {
    const { gl, canvas } = this;
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(...(picking ? [0, 0, 0, 0] : [0.957, 0.961, 0.969, 1]));
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.uniformMatrix3fv(this.uniform("axes"), true, [...view.right, ...view.down, ...view.forward]);
    gl.uniform3fv(this.uniform("eye"), view.eye);
    gl.uniform2f(this.uniform("viewport"), canvas.width, canvas.height);
    gl.uniform1f(this.uniform("focal"), canvas.height / 2 / Math.tan(scene.start.fov / 2));
    gl.uniform1i(this.uniform("labelled"), this.labelled);
    gl.uniform1i(this.uniform("selected"), this.selected);
    gl.uniform1i(this.uniform("picking"), picking);
    gl.drawArrays(gl.TRIANGLES, 0, 6 * this.drawn);
  }

  // The instance of the nearest Gaussian that is not faint at a pixel; -1 where there is none.
  pick(view, x, y) {
    const gl = this.gl, pixel = new Uint8Array(4);
    gl.disable(gl.BLEND);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(x, this.canvas.height - 1 - y, 1, 1);
    this.draw(view, true);
    gl.readPixels(x, this.canvas.height - 1 - y, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
    gl.disable(gl.SCISSOR_TEST);
    gl.enable(gl.BLEND);
    return pixel[0] + 256 * pixel[1] + 65536 * pixel[2] - 1;
  }
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const plus = (a, b, times = 1) => [0, 1, 2].map((i) => a[i] + times * b[i]);
const unit = (a) => plus([0, 0, 0], a, 1 / Math.hypot(...a));

// A camera that turns about a point, upright.
class Orbit {
  constructor({ position, look_at, up }) {
    this.up = unit(up);
    this.target = look_at;
    const out = plus(position, look_at, -1);
    this.distance = this.first = Math.hypot(...out);
    this.pitch = Math.asin(Math.max(-1, Math.min(1, dot(out, this.up) / this.distance)));
    const flat = plus(out, this.up, -dot(out, this.up));
    this.north = unit(Math.hypot(...flat) > 1e-6 * this.distance ? flat : cross(this.up, [0.36, 0.48, 0.8]));
    this.east = cross(this.up, this.north);
    this.yaw = 0;
  }

  view() {
    const level = plus(plus([0, 0, 0], this.north, Math.cos(this.yaw)), this.east, Math.sin(this.yaw));
    const out = plus(plus([0, 0, 0], level, Math.cos(this.pitch)), this.up, Math.sin(this.pitch));
    const forward = plus([0, 0, 0], out, -1), right = unit(cross(forward, this.up));
    const eye = plus(this.target, out, this.distance);
    return { eye, forward, right, down: cross(forward, right), near: scene.start.near };
  }

  turn(dx, dy) {
    this.yaw -= dx;
    this.pitch = Math.max(-STEEPEST, Math.min(STEEPEST, this.pitch + dy));
  }

  move(dx, dy) {
    const { right, down } = this.view(), far = this.distance * Math.tan(scene.start.fov / 2) * 2;
    this.target = plus(plus(this.target, right, -dx * far), down, -dy * far);
  }

  zoom(factor) { this.distance = Math.max(1e-3 * this.first, Math.min(100 * this.first, this.distance * factor)); }

  lookAt(center, size) {
    this.target = center;
    const { fov, near } = scene.start; // nothing nearer than that is drawn
    this.distance = Math.max(size / Math.tan(fov / 2), 0.05 * this.first, size + near);
  }
}

const KEYS = {
  ArrowLeft: (orbit) => orbit.turn(-0.1, 0),
  ArrowRight: (orbit) => orbit.turn(0.1, 0),
  ArrowUp: (orbit) => orbit.turn(0, -0.1),
  ArrowDown: (orbit) => orbit.turn(0, 0.1),
  "+": (orbit) => orbit.zoom(0.9),
  "=": (orbit) => orbit.zoom(0.9), // where + takes Shift
  "-": (orbit) => orbit.zoom(1 / 0.9),
};

function control(canvas, orbit, changed, clicked) {
  const fingers = new Map();
  let travelled = 0;
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, event);
    if (fingers.size === 1) travelled = 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = fingers.get(event.pointerId);
    if (!last) return;
    const height = canvas.clientHeight, dx = (event.clientX - last.clientX) / height;
    const dy = (event.clientY - last.clientY) / height;
    travelled += height * Math.hypot(dx, dy);
    if (fingers.size === 2) {
      const [other] = [...fingers.values()].filter((one) => one.pointerId !== event.pointerId);
      const apart = (one) => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY);
      orbit.zoom(apart(last) / Math.max(apart(event), 1));
      orbit.move(dx / 2, dy / 2);
    } else if (event.buttons & 2 || event.shiftKey) orbit.move(dx, dy);
    else orbit.turn(3 * dx, 3 * dy);
    fingers.set(event.pointerId, event);
    changed();
  });
  for (const kind of ["pointerup", "pointercancel"])
    canvas.addEventListener(kind, (event) => {
      if (fingers.delete(event.pointerId) && kind === "pointerup" && !fingers.size && travelled < 4) clicked(event);
    });
  canvas.addEventListener("keydown", (event) => {
    const act = KEYS[event.key];
    if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    act(orbit);
    changed();
  });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    orbit.zoom(Math.exp(0.001 * event.deltaY));
    changed();
  }, { passive: false });
}

async function start() {
  const instances = new Uint16Array(await unpacked("instances"));
  const canvas = document.querySelector("canvas"), list = document.querySelector("ol");
  const splats = new Splats(canvas, read(await unpacked("gaussians"), instances)), rows = new Map();
  const orbit = new Orbit(scene.start);
  let stale = true, waiting = false;

  function redraw(resort = true) {
    stale ||= resort;
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      const ratio = Math.min(devicePixelRatio, 2), width = Math.round(canvas.clientWidth * ratio);
      const height = Math.round(canvas.clientHeight * ratio);
      if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
      const view = orbit.view();
      if (stale) splats.sort(view);
      stale = false;
      splats.draw(view);
      document.body.dataset.drawn = splats.drawn;
    });
  }

  function show(wanted) { // wanted: whether to show an instance
    for (const [id, row] of rows) {
      const is = wanted(id), eye = row.querySelector(".eye"); // asked once: it may ask what is shown
      splats.shown[id] = is;
      row.classList.toggle("hidden", !is);
      eye.textContent = is ? "hide" : "show";
      eye.setAttribute("aria-label", `${is ? "Hide" : "Show"} ${row.querySelector(".name").textContent}`);
    }
    const alone = [...rows.keys()].filter((id) => splats.shown[id]).length === 1;
    for (const [id, row] of rows)
      row.querySelector(".only").setAttribute("aria-pressed", alone && Boolean(splats.shown[id]));
    redraw();
  }

  function select(id) {
    splats.selected = id;
    for (const [other, row] of rows) {
      row.classList.toggle("selected", other === id);
      row.querySelector(".name").setAttribute("aria-pressed", other === id);
    }
    rows.get(id)?.scrollIntoView({ block: "nearest" });
    redraw(false);
  }

  const isOnly = (id) => [...rows.keys()].every((other) => Boolean(splats.shown[other]) === (other === id));
  for (const object of scene.objects) {
    const row = document.querySelector("template").content.firstElementChild.cloneNode(true);
    const click = (name, does) => row.querySelector(name).addEventListener("click", does);
    row.dataset.id = object.id;
    row.querySelector(".name").textContent = object.name;
    row.querySelector(".about").textContent = object.about;
    row.querySelector("img").src = object.thumbnail;
    row.querySelector(".go").title = `Go to ${object.name}`;
    row.querySelector(".go").setAttribute("aria-label", `Go to ${object.name}`);
    row.querySelector(".only").setAttribute("aria-label", `Show ${object.name} only`);
    row.querySelector(".swatch").style.background = `rgb(${object.color})`;
    click(".name", () => select(splats.selected === object.id ? -1 : object.id));
    click(".eye", () => show((id) => (id === object.id ? !splats.shown[id] : splats.shown[id])));
    click(".only", () => show(isOnly(object.id) ? () => 1 : (id) => id === object.id));
    click(".go", () => {
      orbit.lookAt(object.center, object.size);
      redraw();
    });
    rows.set(object.id, row);
    list.append(row);
  }
  document.getElementById("all").addEventListener("click", () => show(() => 1));
  document.getElementById("reset").addEventListener("click", () => {
    Object.assign(orbit, new Orbit(scene.start));
    redraw();
  });
  document.getElementById("labels").addEventListener("change", (event) => {
    splats.labelled = event.target.checked;
    redraw(false);
  });
  document.getElementById("search").addEventListener("input", (event) => {
    const words = event.target.value.trim().toLowerCase(); // phones put a space behind a word
    for (const object of scene.objects) rows.get(object.id).hidden = !object.name.toLowerCase().includes(words);
    document.getElementById("none").hidden = [...rows.values()].some((row) => !row.hidden);
  });
  control(canvas, orbit, redraw, (event) => {
    const box = canvas.getBoundingClientRect(), ratio = canvas.width / box.width;
    const [x, y] = [event.clientX - box.x, event.clientY - box.y].map((place) => Math.floor(place * ratio));
    select(splats.pick(orbit.view(), x, y));
  });
  canvas.addEventListener("webglcontextlost", () => tell("The graphics card was lost; load the page again."));
  new ResizeObserver(() => redraw(false)).observe(canvas);
  select(-1);
  show(() => 1);
}

function tell(problem) { document.getElementById("problem").textContent = problem; }

start().catch((error) => tell(error.message));
