// Shows a model under light that the mouse moves. Data and image model: mvps/viewer/__init__.py.
"use strict";
(async () => {
  const byId = (name) => document.getElementById(name);
  const canvas = byId("viewer"), said = byId("viewer-said");
  const about = JSON.parse(byId("viewer-about").textContent);
  const gl = canvas.getContext("webgl2", { antialias: true });
  if (!gl) { said.textContent = "This browser has no WebGL 2, which the viewer needs."; return; }

  // ---- data ----
  const packed = Uint8Array.from(atob(byId("viewer-data").textContent), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = await new Response(stream).arrayBuffer();
  const V = about.vertices, F = about.faces;
  let at = 0;
  const take = (length) => { const part = bytes.slice(at, at + length); at += length; return part; };
  const arrays = { position: take(6 * V), normal: take(6 * V), albedo: take(3 * V), weight: take(4 * V), other: take(2 * V), faces: take(12 * F) };

  // ---- small vectors and matrices (columns) ----
  const add = (a, b, s = 1) => a.map((x, i) => x + s * b[i]);
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unit = (a) => { const n = Math.hypot(...a) || 1; return a.map((x) => x / n); };
  const turned = (v, axis, angle) => {
    const c = Math.cos(angle), s = Math.sin(angle), d = dot(axis, v) * (1 - c), x = cross(axis, v);
    return v.map((value, i) => value * c + x[i] * s + axis[i] * d);
  };
  const product = (a, b) => Array.from({ length: 16 }, (_, i) => {
    let sum = 0;
    for (let k = 0; k < 4; k++) sum += a[4 * k + (i % 4)] * b[4 * Math.floor(i / 4) + k];
    return sum;
  });
  const looking = (eye, forward, up) => {
    const right = unit(cross(forward, up)), above = cross(right, forward);
    return [right[0], above[0], -forward[0], 0, right[1], above[1], -forward[1], 0, right[2], above[2], -forward[2], 0,
      -dot(right, eye), -dot(above, eye), dot(forward, eye), 1];
  };

  // ---- state ----
  const centre = about.low.map((x, i) => (x + about.high[i]) / 2);
  const radius = Math.hypot(...about.low.map((x, i) => about.high[i] - x)) / 2;
  const up = unit(about.up);
  let from = unit(about.from), distance = 4.2 * radius;
  let light = unit(add(add(from, up, 0.5), cross(up, from), 0.5));

  // ---- programs ----
  const VERTEX = `#version 300 es
    in vec3 position; in vec3 normal; in vec3 albedo; in vec4 weight; in vec2 other;
    uniform vec3 low, high; uniform mat4 view;
    out vec3 x, n, rho, seen; out vec4 w;
    void main() {
      x = mix(low, high, position); n = normal; rho = albedo; w = weight; seen = vec3(other, 0.0);
      gl_Position = view * vec4(x, 1.0);
    }`;
  const FRAGMENT = `#version 300 es
    precision highp float; precision highp sampler2DShadow;
    in vec3 x, n, rho, seen; in vec4 w;
    uniform vec3 eye, light, tint[4]; uniform vec4 sharpness, lobeWhite;
    uniform float white, grazing, exposure, fill; uniform int layer; uniform bool microfacet, traced;
    uniform mat4 fromLight; uniform sampler2DShadow depths;
    out vec4 colour;
    float D(float c) { float g = 1.0 - max(c, 0.0); return 1.0 + grazing * g * g * g; }
    vec3 shine(vec3 N, vec3 v, vec3 l) {
      float hn = dot(normalize(v + l), N);
      vec3 sum = vec3(0.0);
      for (int k = 0; k < 4; k++) {
        float s = sharpness[k], lobe = exp(s * (hn - 1.0)), spread = 1.0 + s / 4.0 * (1.0 - hn * hn);
        sum += w[k] * w[k] * lobeWhite[k] * tint[k] * (microfacet ? 1.0 / (spread * spread) : lobe);
      }
      return sum;
    }
    float visibility(vec3 N) {
      if (traced) return seen.y;
      vec4 p = fromLight * vec4(x, 1.0);
      vec3 q = p.xyz * 0.5 + 0.5;
      q.z -= 0.004;
      float sum = 0.0;
      for (int i = -1; i <= 1; i++) for (int j = -1; j <= 1; j++) sum += texture(depths, q + vec3(i, j, 0) / 2048.0);
      return sum / 9.0;
    }
    vec3 srgb(vec3 c) { c = clamp(c, 0.0, 1.0); return mix(12.92 * c, 1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, c)); }
    void main() {
      vec3 N = normalize(n), v = normalize(eye - x), body = rho * rho * white;
      if (layer == 3) { colour = vec4((N + 1.0) / 2.0, 1.0); return; }
      if (layer == 4) { colour = vec4(vec3(seen.x), 1.0); return; }
      if (layer == 1) { colour = vec4(srgb(body * exposure), 1.0); return; }
      float lit = max(dot(N, light), 0.0) * visibility(N);
      vec3 matte = layer == 2 ? vec3(0.0) : body * D(dot(N, light)) * D(dot(N, v));
      vec3 shown = (matte + shine(N, v, light)) * lit;
      float lamp = max(dot(N, v), 0.0);
      shown += fill * ((layer == 2 ? vec3(0.0) : body * D(lamp) * D(lamp)) + shine(N, v, v)) * lamp;
      colour = vec4(srgb(shown * exposure), 1.0);
    }`;
  const DEPTH = `#version 300 es
    precision highp float;
    void main() {}`;
  const compiled = (vertex, fragment) => {
    const made = gl.createProgram();
    [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]].forEach(([kind, text]) => {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(made, shader);
    });
    ["position", "normal", "albedo", "weight", "other"].forEach((name, k) => gl.bindAttribLocation(made, k, name));
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
    return made;
  };
  const shown = compiled(VERTEX, FRAGMENT), deep = compiled(VERTEX, DEPTH);
  const set = (program, name, kind, ...values) => gl["uniform" + kind](gl.getUniformLocation(program, name), ...values);

  // ---- buffers ----
  const vertexArray = gl.createVertexArray();
  gl.bindVertexArray(vertexArray);
  const buffers = [["position", 3, gl.UNSIGNED_SHORT], ["normal", 3, gl.SHORT], ["albedo", 3, gl.UNSIGNED_BYTE],
    ["weight", 4, gl.UNSIGNED_BYTE], ["other", 2, gl.UNSIGNED_BYTE]].map(([name, size, type], k) => {
    const buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, arrays[name], gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(k);
    gl.vertexAttribPointer(k, size, type, true, 0, 0);
    return buffer;
  });
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, arrays.faces, gl.STATIC_DRAW);

  const SIDE = 2048;
  const depths = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, depths);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.DEPTH_COMPONENT24, SIDE, SIDE);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_COMPARE_MODE, gl.COMPARE_REF_TO_TEXTURE);
  [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER].forEach((name) => gl.texParameteri(gl.TEXTURE_2D, name, gl.LINEAR));
  [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T].forEach((name) => gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE));
  const frame = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, depths, 0);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  gl.enable(gl.DEPTH_TEST);

  // ---- drawing ----
  const common = (program, view) => {
    gl.useProgram(program);
    set(program, "low", "3fv", about.low);
    set(program, "high", "3fv", about.high);
    set(program, "view", "Matrix4fv", false, view);
  };
  const lightView = () => {
    const helper = Math.abs(dot(light, up)) > 0.99 ? cross(up, from) : up;
    const scale = 1 / (1.02 * radius);
    const box = [scale, 0, 0, 0, 0, scale, 0, 0, 0, 0, -scale / 2, 0, 0, 0, -1, 1];
    return product(box, looking(add(centre, light, 2 * radius), light.map((x) => -x), helper));
  };
  const draw = () => {
    const across = Math.round(canvas.clientWidth * devicePixelRatio), down = Math.round(canvas.clientHeight * devicePixelRatio);
    if (canvas.width !== across || canvas.height !== down) { canvas.width = across; canvas.height = down; }
    const lit = lightView();
    gl.bindVertexArray(vertexArray);
    if (!about.served) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
      gl.viewport(0, 0, SIDE, SIDE);
      gl.clear(gl.DEPTH_BUFFER_BIT);
      common(deep, lit);
      gl.drawElements(gl.TRIANGLES, 3 * F, gl.UNSIGNED_INT, 0);
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    }
    const eye = add(centre, from, distance), near = Math.max(distance - 1.1 * radius, 0.01 * radius), far = distance + 1.1 * radius;
    const focal = 1 / Math.tan(0.26), aspect = across / down;
    const lens = [focal / Math.max(aspect, 1), 0, 0, 0, 0, focal * Math.min(aspect, 1), 0, 0, 0, 0, -(far + near) / (far - near), -1, 0, 0, -2 * far * near / (far - near), 0];
    if (aspect >= 1) { lens[0] = focal / aspect; lens[5] = focal; }
    gl.viewport(0, 0, across, down);
    gl.clearColor(0.13, 0.13, 0.13, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    common(shown, product(lens, looking(eye, from.map((x) => -x), up)));
    set(shown, "eye", "3fv", eye);
    set(shown, "light", "3fv", light);
    set(shown, "tint", "3fv", about.tint.flat());
    set(shown, "sharpness", "4fv", about.sharpness);
    set(shown, "lobeWhite", "4fv", about.lobe_white);
    set(shown, "white", "1f", about.white);
    set(shown, "grazing", "1f", about.grazing);
    set(shown, "exposure", "1f", 2 ** Number(byId("viewer-exposure").value) / about.white / 1.5);
    set(shown, "fill", "1f", Number(byId("viewer-fill").value));
    set(shown, "layer", "1i", byId("viewer-layer").selectedIndex);
    set(shown, "microfacet", "1i", about.microfacet ? 1 : 0);
    set(shown, "traced", "1i", about.served ? 1 : 0);
    set(shown, "fromLight", "Matrix4fv", false, lit);
    set(shown, "depths", "1i", 0);
    gl.drawElements(gl.TRIANGLES, 3 * F, gl.UNSIGNED_INT, 0);
    canvas.dataset.drawn = String(Number(canvas.dataset.drawn || 0) + 1);
  };
  let waiting = false;
  const later = () => {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => { waiting = false; draw(); });
  };

  // ---- exact shadows, from the server ----
  const other = new Uint8Array(arrays.other);
  let asking = false, again = false;
  const ask = async () => {
    if (!about.served) return;
    if (asking) { again = true; return; }
    asking = true;
    const answer = await fetch("shadow?light=" + light.map((x) => x.toFixed(6)).join(","));
    const seen = new Uint8Array(await answer.arrayBuffer());
    for (let i = 0; i < V; i++) other[2 * i + 1] = seen[i];
    gl.bindBuffer(gl.ARRAY_BUFFER, buffers[4]);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, other);
    canvas.dataset.traced = String(Number(canvas.dataset.traced || 0) + 1);
    asking = false;
    later();
    if (again) { again = false; ask(); }
  };

  // ---- hands ----
  const move = (x, y, ofLight) => {
    const right = unit(cross(up, from));
    if (ofLight) {
      const above = cross(from, right);
      light = unit(turned(turned(light, above, x), right, y));
      ask();
    } else {
      from = turned(from, up, -x);
      const lifted = turned(from, unit(cross(up, from)), -y);
      if (Math.abs(dot(lifted, up)) < 0.995) from = unit(lifted);
    }
    later();
  };
  let held = null;
  canvas.addEventListener("pointerdown", (e) => {
    held = [e.clientX, e.clientY, e.button === 2 || e.shiftKey || byId("viewer-drag").value === "light"];
    canvas.setPointerCapture(e.pointerId);
    canvas.focus();
  });
  canvas.addEventListener("pointermove", (e) => {
    if (!held) return;
    move((e.clientX - held[0]) / 150, (e.clientY - held[1]) / 150, held[2]);
    held = [e.clientX, e.clientY, held[2]];
  });
  canvas.addEventListener("pointerup", () => { held = null; });
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener("wheel", (e) => {
    e.preventDefault();
    distance = Math.min(Math.max(distance * Math.exp(e.deltaY / 800), 1.2 * radius), 20 * radius);
    later();
  }, { passive: false });
  canvas.addEventListener("keydown", (e) => {
    const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[e.key];
    if (step) { e.preventDefault(); move(step[0], step[1], e.shiftKey); }
  });
  ["viewer-layer", "viewer-fill", "viewer-exposure"].forEach((name) => byId(name).addEventListener("input", later));
  new ResizeObserver(later).observe(canvas);
  window.mvpsViewer = { look: (direction) => { from = unit(direction); later(); }, lightFrom: (direction) => { light = unit(direction); ask(); later(); } };
  ask();
  later();
})().catch((error) => { document.getElementById("viewer-said").textContent = "The viewer failed: " + error.message; console.error(error); });
