// In browsers that draw on the processor (SwiftShader), draw viser's Gaussians as one list of triangles. viser draws an
// instance of two triangles each, and such a browser takes every instance for a draw call of its own: twenty times the
// time. A shader that is not the one known here is left alone.
(() => {
  const gl = document.createElement("canvas").getContext("webgl2"), told = gl?.getExtension("WEBGL_debug_renderer_info");
  if (!/swiftshader|llvmpipe|software/i.test(told ? gl.getParameter(told.UNMASKED_RENDERER_WEBGL) : "")) return;
  const WIDTH = 1024, ours = WebGL2RenderingContext.prototype, theirs = {};
  const shaders = new WeakSet(), programs = new WeakMap(), orders = new WeakMap();

  function instead(name, make) {
    theirs[name] = ours[name];
    ours[name] = make(theirs[name]);
  }

  instead("shaderSource", (set) => function (shader, source) {
    const [before, after] = source.split("attribute uint sortedIndex;");
    const body = after?.replace(/\bposition\b/g, "corner").replace(/void main\s*\(\)\s*\{/, `void main() {
      int nth = gl_VertexID / 6, vertex = int[6](0, 2, 1, 0, 3, 2)[gl_VertexID - 6 * nth];
      vec2 corner = vec2(vertex == 1 || vertex == 2 ? 2 : -2, vertex > 1 ? 2 : -2);
      uint sortedIndex = texelFetch(order, ivec2(nth % ${WIDTH}, nth / ${WIDTH}), 0).x;`);
    if (body) shaders.add(shader);
    set.call(this, shader, body ? `${before}uniform highp usampler2D order;${body}` : source);
  });
  instead("attachShader", (attach) => function (program, shader) {
    if (shaders.has(shader)) programs.set(program, null);
    attach.call(this, program, shader);
  });

  // The order of the Gaussians is the one list of whole numbers that viser changes: it comes as a texture, too.
  function keep(gl, numbers) {
    const unit = gl.getParameter(gl.MAX_COMBINED_TEXTURE_IMAGE_UNITS) - 1, active = gl.getParameter(gl.ACTIVE_TEXTURE);
    const packing = [gl.UNPACK_FLIP_Y_WEBGL, gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, gl.UNPACK_ALIGNMENT];
    const packed = packing.map((name) => gl.getParameter(name)), height = Math.ceil(numbers.length / WIDTH);
    const texels = new Uint32Array(WIDTH * height);
    texels.set(numbers);
    gl.activeTexture(gl.TEXTURE0 + unit);
    packing.forEach((name, i) => gl.pixelStorei(name, [false, false, 4][i]));
    if (!orders.has(gl)) orders.set(gl, { unit, texture: gl.createTexture() });
    gl.bindTexture(gl.TEXTURE_2D, orders.get(gl).texture);
    theirs.texImage2D.call(gl, gl.TEXTURE_2D, 0, gl.R32UI, WIDTH, height, 0, gl.RED_INTEGER, gl.UNSIGNED_INT, texels);
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
      gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
    packing.forEach((name, i) => gl.pixelStorei(name, packed[i]));
    gl.activeTexture(active);
  }
  const isOrder = (target, numbers) => target === ours.ARRAY_BUFFER && numbers instanceof Uint32Array;
  instead("bufferData", (set) => function (target, numbers, usage, ...more) {
    set.call(this, target, numbers, usage, ...more);
    if (isOrder(target, numbers) && usage === this.DYNAMIC_DRAW) keep(this, numbers);
  });
  instead("bufferSubData", (set) => function (target, from, numbers, ...more) {
    set.call(this, target, from, numbers, ...more);
    if (isOrder(target, numbers) && !from) keep(this, numbers);
  });
  theirs.texImage2D = ours.texImage2D;

  instead("drawElementsInstanced", (draw) => function (mode, count, type, from, instances) {
    const program = count === 6 && this.getParameter(this.CURRENT_PROGRAM), kept = orders.get(this);
    if (!kept || !programs.has(program)) return draw.call(this, mode, count, type, from, instances);
    if (!programs.get(program)) programs.set(program, this.getUniformLocation(program, "order"));
    this.uniform1i(programs.get(program), kept.unit);
    this.drawArrays(mode, 0, 6 * instances);
  });
})();
