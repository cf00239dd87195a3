// Shows the particles of a run in every element of the class "particle-view", as `cortado.pictures.particle_view` writes it:
// shaded discs that play, stop, turn and take their colour from the phase or the speed. WebGL 2, and nothing else.
"use strict";
(() => {
  const VERTEX = `#version 300 es
    in vec3 place, next; in float speed, nextSpeed; in vec3 colour, nextColour;
    uniform mat4 turned; uniform vec3 middle, half_; uniform vec4 lens;
    uniform float part, radius, pixels, bySpeed, jump;
    out vec3 tint; out vec3 seen;
    vec3 scale(float s) {
      vec3 slow = vec3(0.15, 0.30, 0.62), mid = vec3(0.25, 0.70, 0.68), fast = vec3(0.98, 0.78, 0.25);
      return s < 0.5 ? mix(slow, mid, 2.0 * s) : mix(mid, fast, 2.0 * s - 1.0);
    }
    void main() {
      vec3 a = place * half_, b = next * half_;
      float share = distance(a, b) < jump ? part : step(0.5, part);  // nothing is drawn on the way across a period
      seen = (turned * vec4(mix(a, b, share), 1.0)).xyz;
      seen.z -= lens.z;
      float depth = lens.w > 0.5 ? -seen.z : lens.z;
      gl_Position = vec4(seen.xy * lens.xy, 0.0, depth);
      gl_PointSize = max(2.0 * radius * lens.y * pixels * 0.5 / depth, 1.0);
      tint = bySpeed > 0.5 ? scale(mix(speed, nextSpeed, share)) : mix(colour, nextColour, share);
      gl_Position.z = depth * (2.0 * clamp(-seen.z / (2.0 * lens.z), 0.0, 1.0) - 1.0);
    }`;
  const FRAGMENT = `#version 300 es
    precision highp float;
    in vec3 tint, seen; uniform float radius, flatDiscs; uniform vec4 lens; out vec4 result;
    void main() {
      vec2 p = 2.0 * gl_PointCoord - 1.0;
      float q = dot(p, p);
      if (q > 1.0) discard;
      vec3 normal = vec3(p.x, -p.y, sqrt(1.0 - q));
      float light = 0.55 + 0.45 * max(dot(normal, normalize(vec3(0.4, 0.75, 0.6))), 0.0);
      gl_FragDepth = clamp((-seen.z - radius * normal.z) / (2.0 * lens.z), 0.0, 1.0);
      result = vec4(tint * (flatDiscs > 0.5 ? 1.0 - 0.18 * q * q : light), 1.0);
    }`;
  const LINE_VERTEX = `#version 300 es
    in vec3 place; uniform mat4 turned; uniform vec4 lens;
    void main() {
      vec3 seen = (turned * vec4(place, 1.0)).xyz;
      seen.z -= lens.z;
      float depth = lens.w > 0.5 ? -seen.z : lens.z;
      gl_Position = vec4(seen.xy * lens.xy, depth * (2.0 * clamp(-seen.z / (2.0 * lens.z), 0.0, 1.0) - 1.0), depth);
    }`;
  const LINE_FRAGMENT = `#version 300 es
    precision highp float; out vec4 result;
    void main() { result = vec4(0.55, 0.53, 0.50, 1.0); }`;

  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));

  function program(gl, vertex, fragment) {
    const made = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    const uniforms = {}, count = gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS);
    for (let k = 0; k < count; k++) {
      const { name } = gl.getActiveUniform(made, k);
      uniforms[name] = gl.getUniformLocation(made, name);
    }
    return { made, uniforms, attribute: (name) => gl.getAttribLocation(made, name) };
  }

  function buffer(gl, data) {
    const made = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, made);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    return made;
  }

  function show(element) {
    const data = JSON.parse(element.querySelector("script").textContent);
    const canvas = element.querySelector("canvas"), play = element.querySelector("[data-play]");
    const slider = element.querySelector("input"), time = element.querySelector("output");
    const colour = element.querySelector("select");
    const gl = canvas.getContext("webgl2", { antialias: true });
    if (!gl) {
      element.querySelector("p").textContent = "The particles are not shown, as this browser has no WebGL 2.";
      element.querySelectorAll("canvas, .controls").forEach((part) => part.remove());
      return;
    }
    const discs = program(gl, VERTEX, FRAGMENT), edges = program(gl, LINE_VERTEX, LINE_FRAGMENT);
    const lines = new Float32Array(data.lines.flat(2)), lineBuffer = buffer(gl, lines);
    const clouds = data.clouds.map((cloud) => ({
      ...cloud,
      positions: buffer(gl, bytes(cloud.positions)),
      speeds: buffer(gl, bytes(cloud.speeds)),
      colours: buffer(gl, bytes(cloud.colours)),
    }));
    const size = Math.hypot(...data.half), last = data.times.length - 1;
    const first = data.dimension === 3 ? { yaw: -0.42, pitch: 0.28 } : { yaw: 0, pitch: 0 };
    let { yaw, pitch } = first, zoom = 1, moment = 0, playing = false, former = 0, asked = false;

    function turned() {
      const [c, s, d, t] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
      return new Float32Array([c, t * s, -d * s, 0, 0, d, t, 0, s, -t * c, d * c, 0, 0, 0, 0, 1]);
    }

    function fitted(width, height) {  // the distance, or in the plane the height, at which everything is within the panel
      const aspect = width / height, tall = data.dimension === 3 ? size : data.half[1];
      const wide = data.dimension === 3 ? size : data.half[0];
      return Math.max(tall, wide / aspect) * (data.dimension === 3 ? 2.4 : 1.12);
    }

    function attribute(shader, name, made, components, kind, offset) {
      const place = shader.attribute(name);
      gl.bindBuffer(gl.ARRAY_BUFFER, made);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, components, kind, kind !== gl.FLOAT, 0, offset);
    }

    function panel(cloud, x, y, width, height) {
      gl.viewport(x, y, width, height);
      const distance = fitted(width, height), focal = data.dimension === 3 ? 2.6 * zoom : zoom;
      const lens = [focal * height / width, focal, distance, data.dimension === 3 ? 1 : 0];
      gl.useProgram(edges.made);
      gl.uniformMatrix4fv(edges.uniforms.turned, false, turned());
      gl.uniform4fv(edges.uniforms.lens, lens);
      attribute(edges, "place", lineBuffer, 3, gl.FLOAT, 0);
      gl.drawArrays(gl.LINES, 0, lines.length / 3);
      gl.useProgram(discs.made);
      const set = discs.uniforms, now = Math.min(Math.floor(moment), last), next = Math.min(now + 1, last);
      gl.uniformMatrix4fv(set.turned, false, turned());
      gl.uniform4fv(set.lens, lens);
      gl.uniform3fv(set.half_, data.half);
      gl.uniform1f(set.part, moment - now);
      gl.uniform1f(set.radius, data.radius);
      gl.uniform1f(set.pixels, height);
      gl.uniform1f(set.jump, 0.5 * Math.max(...data.half));
      gl.uniform1f(set.bySpeed, colour.value === "speed" ? 1 : 0);
      gl.uniform1f(set.flatDiscs, data.dimension === 3 ? 0 : 1);
      const n = data.particles, d = data.dimension, still = cloud.still ? 0 : 3 * n;
      for (const [prefix, k] of [["", now], ["next", next]]) {
        const named = (word) => (prefix ? prefix + word[0].toUpperCase() + word.slice(1) : word);
        attribute(discs, prefix || "place", cloud.positions, d, gl.SHORT, 2 * d * n * k);
        attribute(discs, named("speed"), cloud.speeds, 1, gl.UNSIGNED_BYTE, n * k);
        attribute(discs, named("colour"), cloud.colours, 3, gl.UNSIGNED_BYTE, still * k);
      }
      gl.drawArrays(gl.POINTS, 0, n);
    }

    function draw(clock) {
      asked = false;
      if (playing) {
        moment += former ? (clock - former) / 1000 * last / data.seconds : 0;
        if (moment >= last) moment = last ? moment % last : 0;
        former = clock;
        slider.value = moment;
      }
      const a = Math.min(Math.floor(moment), last), b = Math.min(a + 1, last);
      time.textContent = `${(data.times[a] + (moment - a) * (data.times[b] - data.times[a])).toFixed(3)} s`;
      const dense = Math.min(window.devicePixelRatio || 1, 2), width = element.clientWidth;
      const stacked = width < 520, count = clouds.length;
      const [across, down] = stacked ? [1, count] : [count, 1];
      const one = width / across, shape = data.dimension === 3 ? 0.62 : data.half[1] / data.half[0] * 1.02;
      const tall = down * Math.min(Math.max(one * shape, 160), 460);
      canvas.style.height = `${tall}px`;
      canvas.width = Math.round(width * dense);
      canvas.height = Math.round(tall * dense);
      gl.clearColor(0.965, 0.96, 0.95, 1);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      gl.enable(gl.DEPTH_TEST);
      clouds.forEach((cloud, k) => {
        const [w, h] = [Math.floor(canvas.width / across), Math.floor(canvas.height / down)];
        panel(cloud, stacked ? 0 : k * w, stacked ? (count - 1 - k) * h : 0, w, h);
        const label = element.querySelectorAll(".name")[k];
        if (label) label.style.cssText = stacked ? `left:0;top:${k * tall / count}px` : `left:${k * one}px;top:0`;
      });
      if (playing) ask();
    }

    function ask() {
      if (!asked) requestAnimationFrame(draw);
      asked = true;
    }

    function turn(x, y) {
      if (data.dimension === 2) return;
      yaw += x;
      pitch = Math.max(-1.5, Math.min(1.5, pitch + y));
      ask();
    }

    function magnify(factor) {
      zoom = Math.max(0.3, Math.min(8, zoom * factor));
      ask();
    }

    play.onclick = () => {
      playing = !playing;
      former = 0;
      play.textContent = playing ? "Pause" : "Play";
      ask();
    };
    slider.oninput = () => {
      moment = Number(slider.value);
      ask();
    };
    colour.onchange = ask;
    element.querySelector("[data-closer]").onclick = () => magnify(1.25);
    element.querySelector("[data-farther]").onclick = () => magnify(0.8);
    element.querySelector("[data-reset]").onclick = () => {
      ({ yaw, pitch } = first);
      magnify(1 / zoom);
    };
    canvas.onpointerdown = (event) => canvas.setPointerCapture(event.pointerId);
    canvas.onpointermove = (event) => event.buttons && turn(event.movementX / 150, event.movementY / 150);
    canvas.onkeydown = (event) => {
      const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[event.key];
      if (!step) return;
      event.preventDefault();
      turn(...step);
    };
    canvas.addEventListener("wheel", (event) => {
      if (!event.ctrlKey) return;  // the page scrolls
      event.preventDefault();
      magnify(Math.exp(-event.deltaY / 300));
    }, { passive: false });
    new ResizeObserver(ask).observe(element);
    ask();
  }

  document.querySelectorAll(".particle-view").forEach(show);
})();
