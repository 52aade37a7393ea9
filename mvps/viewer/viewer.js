// Shows a model under lights that the mouse moves, and under an environment. Data and image model: mvps/viewer/__init__.py.
"use strict";
(async () => {
  const byId = (name) => document.getElementById(name);
  const canvas = byId("viewer"), exact = byId("viewer-exact"), said = byId("viewer-said");
  const about = JSON.parse(byId("viewer-about").textContent);
  const gl = canvas.getContext("webgl2", { antialias: true });
  if (!gl) { said.textContent = "This browser has no WebGL 2, which the viewer needs."; return; }

  // ---- data ----
  const V = about.vertices, F = about.faces;
  const unpacked = async (text) => {
    const packed = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    const bytes = await new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer();
    let at = 0;
    const take = (length) => { const part = bytes.slice(at, at + length); at += length; return part; };
    return { position: take(6 * V), normal: take(6 * V), albedo: take(3 * V), weight: take(4 * V), hue: take(3 * V),
      confidence: take(V), faces: take(12 * F) };
  };
  const arrays = await unpacked(byId("viewer-data").textContent);

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

  // ---- state, in the model's own frame: the world's, from the middle of its box ----
  const centre = about.low.map((x, i) => (x + about.high[i]) / 2);
  const radius = Math.hypot(...about.low.map((x, i) => about.high[i] - x)) / 2;
  const up = unit(about.up);
  let from = unit(about.from), distance = 4.2 * radius;
  // A photograph's camera, until the object is turned: eye, forward, above; focal, middle, size (pixels, x and y).
  let camera = null;
  const aside = cross(up, from);
  const placed = [[0.5, 0.5], [0.5, -0.8], [-0.3, 0.9], [1.2, 0]].map(([high, right]) => unit(add(add(from, up, high), aside, right)));
  // colour: linear, the strength included.
  const lights = [{ direction: placed[0], colour: [1, 1, 1] }];
  let chosen = 0;

  // ---- programs ----
  const MOST = 4, SKY = 32, SIDE = 2048;
  const ATTRIBUTES = [["position", 3, gl.UNSIGNED_SHORT], ["normal", 3, gl.SHORT], ["albedo", 3, gl.UNSIGNED_BYTE],
    ["weight", 4, gl.UNSIGNED_BYTE], ["hue", 3, gl.UNSIGNED_BYTE], ["confidence", 1, gl.UNSIGNED_BYTE], ["reached", 4, gl.UNSIGNED_BYTE]];
  const MODEL = `
    uniform vec3 tint[4]; uniform vec4 sharpness, lobeWhite; uniform float white, hueWhite, grazing; uniform int layer; uniform bool microfacet;
    float D(float c) { float g = 1.0 - max(c, 0.0); return 1.0 + grazing * g * g * g; }
    vec3 shine(vec4 w, vec3 h, vec3 N, vec3 v, vec3 l, float wide) {
      float hn = dot(normalize(v + l), N);
      vec3 sum = vec3(0.0);
      for (int k = 0; k < 4; k++) {
        float duller = 1.0 / (1.0 + sharpness[k] * wide / 4.0), s = sharpness[k] * duller;
        float lobe = exp(s * (hn - 1.0)), spread = 1.0 + s / 4.0 * (1.0 - hn * hn);
        sum += w[k] * w[k] * lobeWhite[k] * tint[k] * duller * (microfacet ? 1.0 / (spread * spread) : lobe);
      }
      return sum * h * h * hueWhite * min(2.0 / max(1.0 + dot(v, l), 1e-6), 4.0);
    }
    // wide: variance of the directions that a light stands for, as in mvps/shading.py.
    vec3 lit(vec3 body, vec4 w, vec3 h, vec3 N, vec3 v, vec3 l, float wide) {
      vec3 matte = layer == 2 ? vec3(0.0) : body * D(dot(N, l)) * D(dot(N, v));
      return (matte + shine(w, h, N, v, l, wide)) * max(dot(N, l), 0.0);
    }`;
  const VERTEX = `#version 300 es
    precision highp float; precision highp int;
    in vec3 position; in vec3 normal; in vec3 albedo; in vec4 weight; in vec3 hue; in float confidence; in vec4 reached; in uint open;
    uniform vec3 low, high, eye, sky[${SKY}], skyColour[${SKY}]; uniform float skyWide[${SKY}]; uniform mat4 view; uniform int around;
    out vec3 x, n, rho, surrounding, h; out vec4 w, seen; out float certain;
    ${MODEL}
    void main() {
      x = mix(low, high, position); n = normal; rho = albedo; w = weight; h = hue; seen = reached; certain = confidence;
      surrounding = vec3(0.0);
      vec3 N = normalize(n), v = normalize(eye - x);
      for (int k = 0; k < around; k++)
        if (((open >> uint(k)) & 1u) == 1u) surrounding += skyColour[k] * lit(rho * rho * white, w, h, N, v, sky[k], skyWide[k]);
      gl_Position = view * vec4(x, 1.0);
    }`;
  const FRAGMENT = `#version 300 es
    precision highp float; precision highp int; precision highp sampler2DArrayShadow;
    in vec3 x, n, rho, surrounding, h; in vec4 w, seen; in float certain;
    uniform vec3 eye, light[${MOST}], lamp[${MOST}]; uniform int lights;
    uniform float exposure, fill, away; uniform vec2 range; uniform bool traced; uniform mat4 fromLight[${MOST}]; uniform sampler2DArrayShadow depths;
    out vec4 colour;
    ${MODEL}
    float visibility(int k) {
      if (traced) return seen[k];
      vec4 p = fromLight[k] * vec4(x, 1.0);
      vec3 q = p.xyz * 0.5 + 0.5;
      q.z -= 0.004;
      float sum = 0.0;
      for (int i = -1; i <= 1; i++) for (int j = -1; j <= 1; j++)
        sum += texture(depths, vec4(q.xy + vec2(i, j) / ${SIDE}.0, float(k), q.z));
      return sum / 9.0;
    }
    vec3 srgb(vec3 c) { c = clamp(c, 0.0, 1.0); return mix(12.92 * c, 1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, c)); }
    void main() {
      vec3 N = normalize(n), v = normalize(eye - x), body = rho * rho * white;
      if (layer == 3) { colour = vec4((N + 1.0) / 2.0, 1.0); return; }
      if (layer == 4) { colour = vec4(vec3(certain), 1.0); return; }
      if (layer == 1) { colour = vec4(srgb(body * exposure), 1.0); return; }
      if (layer == 5) { colour = vec4(vec3(1.0 - (length(eye - x) - range.x) / (range.y - range.x)), 1.0); return; }
      if (layer == 6) {
        float hidden = 0.0, all = 0.0;
        for (int k = 0; k < lights; k++) {
          float flux = max(dot(N, light[k]), 0.0) * dot(lamp[k], vec3(1.0 / 3.0));
          all += flux;
          hidden += flux * (1.0 - visibility(k));
        }
        colour = vec4(vec3(hidden / max(all, 1e-12)), 1.0);
        return;
      }
      vec3 shown = surrounding + fill * away * away / dot(eye - x, eye - x) * lit(body, w, h, N, v, v, 0.0);
      for (int k = 0; k < lights; k++) shown += lamp[k] * lit(body, w, h, N, v, light[k], 0.0) * visibility(k);
      colour = vec4(srgb(shown * exposure), 1.0);
    }`;
  const DEPTH = `#version 300 es
    precision highp float; precision highp int;
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
    [...ATTRIBUTES.map(([name]) => name), "open"].forEach((name, k) => gl.bindAttribLocation(made, k, name));
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
    return made;
  };
  const set = (program, name, kind, ...values) => gl["uniform" + kind](gl.getUniformLocation(program, name), ...values);

  // ---- what the graphics processor holds, and may lose ----
  // Which of the lights reach a vertex, and which of an environment's, a bit each.
  const reached = new Uint8Array(4 * V).fill(255);
  let open = new Uint32Array(V);
  const uploaded = () => {
    const shown = compiled(VERTEX, FRAGMENT), deep = compiled(VERTEX, DEPTH), vertexArray = gl.createVertexArray();
    gl.bindVertexArray(vertexArray);
    const filled = (values, k) => {
      const buffer = gl.createBuffer();
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.DYNAMIC_DRAW);
      gl.enableVertexAttribArray(k);
      return buffer;
    };
    const buffers = Object.fromEntries(ATTRIBUTES.map(([name, size, type], k) => {
      const buffer = filled(name === "reached" ? reached : arrays[name], k);
      gl.vertexAttribPointer(k, size, type, true, 0, 0);
      return [name, buffer];
    }));
    buffers.open = filled(open, ATTRIBUTES.length);
    gl.vertexAttribIPointer(ATTRIBUTES.length, 1, gl.UNSIGNED_INT, 0, 0);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, arrays.faces, gl.STATIC_DRAW);

    const depths = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, depths);
    if (!about.served) gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.DEPTH_COMPONENT24, SIDE, SIDE, MOST);
    else gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.DEPTH_COMPONENT24, 1, 1, 1);
    gl.texParameteri(gl.TEXTURE_2D_ARRAY, gl.TEXTURE_COMPARE_MODE, gl.COMPARE_REF_TO_TEXTURE);
    [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER].forEach((name) => gl.texParameteri(gl.TEXTURE_2D_ARRAY, name, gl.LINEAR));
    [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T].forEach((name) => gl.texParameteri(gl.TEXTURE_2D_ARRAY, name, gl.CLAMP_TO_EDGE));
    gl.enable(gl.DEPTH_TEST);
    return { shown, deep, vertexArray, buffers, depths, frame: gl.createFramebuffer() };
  };
  let { shown, deep, vertexArray, buffers, depths, frame } = uploaded();
  const refilled = (name, values) => {
    gl.bindBuffer(gl.ARRAY_BUFFER, buffers[name]);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, values);
  };

  // ---- drawing ----
  let sky = [];
  // In pixels of the canvas: focal lengths and where the axis meets the picture.
  const seenBy = (across, down) => {
    if (!camera) {
      const focal = Math.min(across, down) / 2 / Math.tan(0.26);
      return { eye: add(centre, from, distance), forward: from.map((x) => -x), above: up, focal: [focal, focal], middle: [across / 2, down / 2] };
    }
    // The whole photograph fits into the canvas.
    const scale = Math.min(down / camera.size[1], across / camera.size[0]), half = [across / 2, down / 2];
    return {
      eye: camera.eye, forward: camera.forward, above: camera.above, focal: camera.focal.map((f) => scale * f),
      middle: half.map((h, i) => h + scale * (camera.middle[i] - camera.size[i] / 2)),
    };
  };
  // Of one material, so that a darker one looks darker.
  const exposure = () => 2 ** Number(byId("viewer-exposure").value) / about.exposed / 1.5;
  const common = (program, view) => {
    gl.useProgram(program);
    set(program, "low", "3fv", about.low);
    set(program, "high", "3fv", about.high);
    set(program, "view", "Matrix4fv", false, view);
  };
  const lightView = (light) => {
    const helper = Math.abs(dot(light, up)) > 0.99 ? cross(up, from) : up;
    const scale = 1 / (1.02 * radius);
    const box = [scale, 0, 0, 0, 0, scale, 0, 0, 0, 0, -scale / 2, 0, 0, 0, -1, 1];
    return product(box, looking(add(centre, light, 2 * radius), light.map((x) => -x), helper));
  };
  const draw = () => {
    if (gl.isContextLost()) return;
    const across = Math.round(canvas.clientWidth * devicePixelRatio), down = Math.round(canvas.clientHeight * devicePixelRatio);
    if (canvas.width !== across || canvas.height !== down) { canvas.width = across; canvas.height = down; }
    const fromLight = lights.map((light) => lightView(light.direction));
    gl.bindVertexArray(vertexArray);
    if (!about.served) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
      gl.viewport(0, 0, SIDE, SIDE);
      fromLight.forEach((matrix, k) => {
        gl.framebufferTextureLayer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, depths, 0, k);
        gl.clear(gl.DEPTH_BUFFER_BIT);
        common(deep, matrix);
        gl.drawElements(gl.TRIANGLES, 3 * F, gl.UNSIGNED_INT, 0);
      });
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    }
    const { eye, forward, above, focal, middle } = seenBy(across, down);
    const away = Math.hypot(...add(eye, centre, -1));
    const near = Math.max(away - 1.1 * radius, 0.01 * radius), far = away + 1.1 * radius;
    const lens = [2 * focal[0] / across, 0, 0, 0, 0, 2 * focal[1] / down, 0, 0, 1 - 2 * middle[0] / across, 2 * middle[1] / down - 1,
      -(far + near) / (far - near), -1, 0, 0, -2 * far * near / (far - near), 0];
    gl.viewport(0, 0, across, down);
    gl.clearColor(0.13, 0.13, 0.13, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    common(shown, product(lens, looking(eye, forward, above)));
    set(shown, "eye", "3fv", eye);
    set(shown, "light", "3fv", lights.flatMap((light) => light.direction));
    set(shown, "lamp", "3fv", lights.flatMap((light) => light.colour));
    set(shown, "lights", "1i", lights.length);
    set(shown, "around", "1i", sky.length);
    if (sky.length) {
      set(shown, "sky", "3fv", sky.flatMap((light) => light.slice(0, 3)));
      set(shown, "skyColour", "3fv", sky.flatMap((light) => light.slice(3, 6)));
      set(shown, "skyWide", "1fv", sky.map((light) => light[6]));
    }
    set(shown, "tint", "3fv", about.tint.flat());
    set(shown, "sharpness", "4fv", about.sharpness);
    set(shown, "lobeWhite", "4fv", about.lobe_white);
    set(shown, "white", "1f", about.white);
    set(shown, "hueWhite", "1f", about.hue_white);
    set(shown, "grazing", "1f", about.grazing);
    set(shown, "exposure", "1f", exposure());
    set(shown, "away", "1f", away);
    set(shown, "range", "2f", away - radius, away + radius);
    set(shown, "fill", "1f", Number(byId("viewer-fill").value));
    set(shown, "layer", "1i", byId("viewer-layer").selectedIndex);
    set(shown, "microfacet", "1i", about.microfacet ? 1 : 0);
    set(shown, "traced", "1i", about.served ? 1 : 0);
    set(shown, "fromLight", "Matrix4fv", false, fromLight.flat());
    set(shown, "depths", "1i", 0);
    gl.drawElements(gl.TRIANGLES, 3 * F, gl.UNSIGNED_INT, 0);
    canvas.dataset.drawn = String(Number(canvas.dataset.drawn || 0) + 1);
    rest();
  };
  let waiting = false;
  const later = () => {
    exact?.setAttribute("hidden", "");
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => { waiting = false; draw(); });
  };

  // ---- exact shadows and environments, from the server ----
  const words = (values) => values.map((x) => x.toFixed(6)).join(",");
  const bytesOf = async (address) => {
    const answer = await fetch(address);
    if (!answer.ok) throw new Error(answer.statusText);
    return answer.arrayBuffer();
  };
  const stale = new Set();
  let asking = false;
  const ask = async (k) => {
    if (!about.served) return;
    stale.add(k);
    if (asking) return;
    asking = true;
    try {
      while (stale.size) {
        const next = Math.min(...stale);
        stale.delete(next);
        if (next >= lights.length) continue;
        const seen = new Uint8Array(await bytesOf("shadow?light=" + words(lights[next].direction)));
        for (let i = 0; i < V; i++) reached[4 * i + next] = seen[i];
        refilled("reached", reached);
        canvas.dataset.traced = String(Number(canvas.dataset.traced || 0) + 1);
        later();
      }
    } finally { asking = false; }
  };
  // Once nothing has changed for REST milliseconds: the same picture, ray by ray, over the canvas. One at a time is asked for.
  const REST = 400, LAYERS = { 0: "image", 2: "specular", 6: "shadow" };
  let resting = 0, tracing = false;
  const trace = async () => {
    const layer = LAYERS[byId("viewer-layer").selectedIndex];
    if (tracing || !layer || stale.size || asking) return;
    tracing = true;
    const then = canvas.dataset.drawn, size = [canvas.width, canvas.height];
    const seen = seenBy(...size);
    const scene = {
      ...seen, eye: add(seen.eye, about.centre), size, layer, lights: lights.map(({ direction, colour }) => ({ direction, colour })),
      fill: Number(byId("viewer-fill").value), environment: byId("viewer-environment").value, turn: Number(byId("viewer-turn").value),
      material: byId("viewer-material").value, exposure: exposure(),
    };
    try {
      const picture = new Blob([await bytesOf("picture?scene=" + encodeURIComponent(JSON.stringify(scene)))], { type: "image/png" });
      URL.revokeObjectURL(exact.src);
      exact.src = URL.createObjectURL(picture);
      await exact.decode();
      exact.hidden = waiting || then !== canvas.dataset.drawn;
    } finally {
      tracing = false;
      if (then !== canvas.dataset.drawn) rest();
    }
  };
  const rest = () => {
    if (!about.served) return;
    clearTimeout(resting);
    resting = setTimeout(() => trace().catch(failed), REST);
  };
  let surrounding = 0;
  const surround = async () => {
    const mine = ++surrounding, name = byId("viewer-environment").value, turn = byId("viewer-turn").value;
    let found = [], bits = new Uint32Array(V);
    if (name) {
      const answer = await bytesOf("environment?of=" + encodeURIComponent(name) + "&turn=" + turn);
      const numbers = new Float32Array(answer.slice(0, answer.byteLength - 4 * V));
      found = Array.from({ length: numbers.length / 7 }, (_, k) => Array.from(numbers.slice(7 * k, 7 * k + 7)));
      bits = new Uint32Array(answer.slice(answer.byteLength - 4 * V));
    }
    // A later choice may have been answered first.
    if (mine !== surrounding) return;
    [sky, open] = [found, bits];
    refilled("open", open);
    canvas.dataset.surrounded = String(Number(canvas.dataset.surrounded || 0) + 1);
    later();
  };

  // Another material on the same vertices.
  let dressing = 0;
  const dress = async () => {
    const mine = ++dressing;
    const answer = JSON.parse(new TextDecoder().decode(await bytesOf("material?of=" + encodeURIComponent(byId("viewer-material").value))));
    const found = await unpacked(answer.data);
    // A later choice may have been answered first.
    if (mine !== dressing) return;
    Object.assign(about, answer.about);
    ["albedo", "weight", "hue"].forEach((name) => refilled(name, arrays[name] = found[name]));
    canvas.dataset.dressed = String(Number(canvas.dataset.dressed || 0) + 1);
    later();
  };

  // ---- hands ----
  const leave = () => {
    if (!camera) return;
    const aside = add(camera.eye, centre, -1), above = camera.above;
    [from, distance, camera] = [unit(aside), Math.min(Math.max(Math.hypot(...aside), 1.2 * radius), 20 * radius), null];
    // Straight from above or below any direction may be up in the picture: the photograph's stays.
    if (Math.hypot(...cross(up, from)) < 1e-3) from = unit(add(from, above, -1e-3 * Math.sign(dot(up, from))));
  };
  const move = (x, y, ofLight) => {
    if (!ofLight) leave();
    if (ofLight) {
      // Of the picture: a photograph's camera may be rolled.
      const right = unit(camera ? cross(camera.forward, camera.above) : cross(up, from)), above = cross(from, right);
      lights[chosen].direction = unit(turned(turned(lights[chosen].direction, above, x), right, y));
      ask(chosen).catch(failed);
    } else {
      from = turned(from, up, -x);
      const axis = cross(up, from), lifted = turned(from, unit(axis), -y), steep = (of) => Math.abs(dot(of, up));
      // Not over the poles, where the picture would turn around, nor near them, but away from there, where photographs may lead.
      if (dot(cross(up, lifted), axis) > 0 && (steep(lifted) < 0.995 || steep(lifted) < steep(from))) from = unit(lifted);
    }
    later();
  };
  const nearer = (factor) => {
    leave();
    distance = Math.min(Math.max(distance / factor, 1.2 * radius), 20 * radius);
    later();
  };
  let held = null;
  // Fingers by their numbers; two of them pinch.
  const fingers = new Map();
  const between = () => { const [a, b] = fingers.values(); return Math.hypot(a[0] - b[0], a[1] - b[1]); };
  canvas.addEventListener("pointerdown", (e) => {
    fingers.set(e.pointerId, [e.clientX, e.clientY]);
    held = [e.clientX, e.clientY, e.button === 2 || e.shiftKey || byId("viewer-drag").value === "light"];
    canvas.setPointerCapture(e.pointerId);
    canvas.focus();
  });
  canvas.addEventListener("pointermove", (e) => {
    if (!held || !fingers.has(e.pointerId)) return;
    const before = fingers.size === 2 ? between() : 0;
    fingers.set(e.pointerId, [e.clientX, e.clientY]);
    if (fingers.size > 1) {
      if (before) nearer(between() / before);
      return;
    }
    move((e.clientX - held[0]) / 150, (e.clientY - held[1]) / 150, held[2]);
    held = [e.clientX, e.clientY, held[2]];
  });
  ["pointerup", "pointercancel"].forEach((name) => canvas.addEventListener(name, (e) => {
    fingers.delete(e.pointerId);
    // The finger that stays goes on from where it is.
    const [left] = fingers.values();
    held = left ? [...left, held && held[2]] : null;
  }));
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener("wheel", (e) => {
    e.preventDefault();
    nearer(Math.exp(-e.deltaY / 800));
  }, { passive: false });
  canvas.addEventListener("keydown", (e) => {
    const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[e.key];
    if (step) { e.preventDefault(); move(step[0], step[1], e.shiftKey); }
  });
  ["viewer-layer", "viewer-fill", "viewer-exposure"].forEach((name) => byId(name).addEventListener("input", later));

  // ---- lights ----
  const list = byId("viewer-light"), tone = byId("viewer-colour"), strength = byId("viewer-strength");
  const listed = () => {
    list.replaceChildren(...lights.map((_, k) => new Option(String(k + 1), String(k), k === chosen, k === chosen)));
    byId("viewer-more").disabled = lights.length === MOST;
    byId("viewer-fewer").disabled = lights.length === 1;
    tone.value = lights[chosen].tone || "#ffffff";
    strength.value = String(lights[chosen].strength ?? 1);
  };
  const coloured = () => {
    const one = lights[chosen];
    [one.tone, one.strength] = [tone.value, Number(strength.value)];
    const code = [1, 3, 5].map((k) => parseInt(tone.value.slice(k, k + 2), 16) / 255);
    one.colour = code.map((c) => one.strength * (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4));
    later();
  };
  list.addEventListener("input", () => { chosen = Number(list.value); listed(); });
  byId("viewer-more").addEventListener("click", () => {
    chosen = lights.push({ direction: placed[lights.length], colour: [1, 1, 1] }) - 1;
    listed();
    ask(chosen).catch(failed);
    later();
  });
  byId("viewer-fewer").addEventListener("click", () => {
    lights.splice(chosen, 1);
    chosen = Math.min(chosen, lights.length - 1);
    listed();
    lights.forEach((_, k) => ask(k).catch(failed));
    later();
  });
  [tone, strength].forEach((control) => control.addEventListener("input", coloured));
  listed();
  const failed = (error) => { said.textContent = "The viewer failed: " + error.message; };
  byId("viewer-material")?.addEventListener("change", () => dress().catch(failed));
  ["viewer-environment", "viewer-turn"].forEach((name) => byId(name)?.addEventListener("change", () => surround().catch(failed)));
  new ResizeObserver(later).observe(canvas);
  canvas.addEventListener("webglcontextlost", (e) => {
    // Else the browser does not give it back.
    e.preventDefault();
    said.textContent = "The graphics processor has lost the picture. If it does not come back, load the page again.";
  });
  canvas.addEventListener("webglcontextrestored", () => {
    try { ({ shown, deep, vertexArray, buffers, depths, frame } = uploaded()); } catch (error) { failed(error); return; }
    said.textContent = "";
    later();
  });
  window.mvpsViewer = {
    // through: in the world's frame.
    look: (through) => {
      camera = { ...through, eye: add(through.eye, about.centre, -1) };
      from = through.forward.map((x) => -x);
      later();
    },
    // The only light, as it was when a photograph was taken.
    lightFrom: (direction, colour) => {
      const most = Math.max(...colour, 1e-12), code = (c) => Math.round(255 * (c <= 0.0031308 ? 12.92 * c : 1.055 * c ** (1 / 2.4) - 0.055));
      const tone = "#" + colour.map((c) => code(c / most).toString(16).padStart(2, "0")).join("");
      lights.splice(0, lights.length, { direction: unit(direction), colour, tone, strength: most });
      chosen = 0;
      byId("viewer-fill").value = "0";
      listed();
      if (byId("viewer-environment").value) { byId("viewer-environment").value = ""; surround().catch(failed); }
      ask(0).catch(failed);
      later();
    },
  };
  // Who waits for it, as the photographs beside do, may use it from now on.
  window.dispatchEvent(new Event("mvpsviewer"));
  ask(0).catch(failed);
  later();
})().catch((error) => { document.getElementById("viewer-said").textContent = "The viewer failed: " + error.message; console.error(error); });
