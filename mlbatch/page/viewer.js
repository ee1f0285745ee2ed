"use strict";
// Points of a scan in a canvas: drawn with WebGL, or without it on the processor; see points.py
// for how a scan is stored. The page gives the canvas; nothing here knows which scans there are.

const PALETTE = ["#2f7ed8", "#e8743b", "#19a979", "#945ecf", "#d9a404", "#ed4a7b", "#13a4b4",
  "#6c8893"];
const AXES = ["#e23b3b", "#2fa84f", "#3b7de2"];
const SCALE = [[68, 60, 150], [49, 104, 180], [33, 145, 150], [70, 180, 90], [215, 185, 40],
  [235, 110, 50]];
const sensorColor = (i) => PALETTE[i % PALETTE.length];
// Of the style sheet; read again for each drawing, since light and dark differ.
const color = (name) => getComputedStyle(document.documentElement)
  .getPropertyValue("--" + name).trim();

// A canvas at the resolution of the screen; gives its context and size in CSS pixels.
function prepared(canvas, height) {
  if (height) canvas.style.height = height + "px";
  const scale = window.devicePixelRatio || 1;
  const width = canvas.clientWidth;
  const high = canvas.clientHeight;
  canvas.width = Math.max(1, Math.round(width * scale));
  canvas.height = Math.max(1, Math.round(high * scale));
  const ctx = canvas.getContext("2d");
  ctx.setTransform(scale, 0, 0, scale, 0, 0);
  ctx.clearRect(0, 0, width, high);
  ctx.font = '12px system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif';
  ctx.textBaseline = "alphabetic";
  return { ctx, width, height: high };
}

// Round steps of an axis: 1, 2 or 5 times a power of ten.
function niceStep(span, count) {
  const raw = span / Math.max(1, count);
  const power = Math.pow(10, Math.floor(Math.log10(raw)));
  return [1, 2, 5, 10].find((one) => one * power >= raw) * power;
}

function bytesOf(base64) {
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

// A scan with its points, from the planes that points.py has packed; data: bytes, or base64.
async function unpackCloud(packed) {
  const deflated = typeof packed.data === "string" ? bytesOf(packed.data) : packed.data;
  const stream = new Blob([deflated]).stream()
    .pipeThrough(new DecompressionStream("deflate-raw"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  const count = packed.shown;
  const words = (plane, found, stride, offset) => {
    const low = 2 * plane * count, high = low + count;
    let sum = 0;
    for (let i = 0; i < count; i++) {
      const coded = bytes[low + i] | bytes[high + i] << 8;
      sum = sum + ((coded >>> 1) ^ -(coded & 1)) & 65535;
      found[stride * i + offset] = sum;
    }
    return found;
  };
  const steps = new Uint16Array(3 * count);
  for (let axis = 0; axis < 3; axis++) words(axis, steps, 3, axis);
  return { ...packed, data: "", steps, time: words(3, new Uint16Array(count), 1, 0),
    ring: words(4, new Uint16Array(count), 1, 0),
    lidar: bytes.subarray(10 * count, 11 * count), bright: bytes.subarray(11 * count) };
}

// -- colours ------------------------------------------------------------------------------------

// Opaque colours as 32-bit words, bytes in the order red, green, blue, alpha.
const word = (r, g, b) => (255 << 24 | b << 16 | g << 8 | r) >>> 0;
const rgbOf = (hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));
const SCALE_WORDS = Uint32Array.from({ length: 256 }, (_, i) => {
  const at = i / 255 * (SCALE.length - 1);
  const k = Math.min(SCALE.length - 2, Math.floor(at));
  return word(...SCALE[k].map((low, j) => Math.round(low + (at - k) * (SCALE[k + 1][j] - low))));
});

function colorsOf(cloud, colouring) {
  const found = new Uint32Array(cloud.shown);
  const lidars = Uint32Array.from({ length: 256 }, (_, i) => word(...rgbOf(sensorColor(i))));
  const [low, high] = cloud.height;
  const step = 255 * cloud.step / (high > low ? high - low : 1);
  const least = 255 * (cloud.low[2] - low) / (high > low ? high - low : 1);
  for (let i = 0; i < found.length; i++) {
    if (colouring === "lidar") found[i] = lidars[cloud.lidar[i]];
    else if (colouring === "time") found[i] = SCALE_WORDS[cloud.time[i] >>> 8];
    else if (colouring === "bright") found[i] = SCALE_WORDS[cloud.bright[i]];
    else {
      const share = Math.round(least + cloud.steps[3 * i + 2] * step);
      found[i] = SCALE_WORDS[Math.max(0, Math.min(255, share))];
    }
  }
  return found;
}

// -- drawing of points --------------------------------------------------------------------------

const VERTEX = `attribute vec3 place; attribute vec4 colour; uniform mat4 clip; uniform vec3 back;
  uniform vec2 size; uniform vec2 far; varying vec3 shade;
  void main() {
    gl_Position = clip * vec4(place, 1.0);
    gl_PointSize = clamp(size.x / gl_Position.w, 1.4 * size.y, 3.5 * size.y);
    shade = mix(colour.rgb, back, 0.6 * smoothstep(far.x, far.y, gl_Position.w));
  }`;
const FRAGMENT = `precision mediump float; varying vec3 shade;
  void main() { gl_FragColor = vec4(shade, 1.0); }`;

// Whether WebGL is done on the processor; browsers do not all tell by failIfMajorPerformanceCaveat.
function isSoftware(gl) {
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const name = gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
  return /SwiftShader|llvmpipe|softpipe|Basic Render/.test(name);
}

// Draw with WebGL; null where there is none, isFast: also where it is done on the processor.
function glPainter(canvas, isFast) {
  const gl = canvas.getContext("webgl", { preserveDrawingBuffer: true, antialias: false });
  if (!gl || (isFast && isSoftware(gl))) return null;
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) return null;
  gl.useProgram(program);
  gl.enable(gl.DEPTH_TEST);
  const uniform = (name) => gl.getUniformLocation(program, name);
  const feed = (name, count, kind, normalized) => {
    const buffer = gl.createBuffer(), at = gl.getAttribLocation(program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, count, kind, normalized, 0, 0);
    let last = null;
    return (values) => {
      if (values === last) return;
      last = values;
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    };
  };
  const setPlaces = feed("place", 3, gl.UNSIGNED_SHORT, false);
  const setColours = feed("colour", 4, gl.UNSIGNED_BYTE, true);
  const [clip, back, size, far] = ["clip", "back", "size", "far"].map(uniform);
  return (cloud, colours, camera) => {
    setPlaces(cloud.steps);
    setColours(colours);
    const ground = rgbOf(color("cloud")).map((one) => one / 255);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(...ground, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(clip, false, camera.matrix(cloud));
    gl.uniform3fv(back, ground);
    gl.uniform2f(size, 0.04 * camera.focal * canvas.height / 2, window.devicePixelRatio || 1);
    gl.uniform2f(far, camera.distance * .6, camera.distance + 1.6 * cloud.view);
    gl.drawArrays(gl.POINTS, 0, cloud.shown);
  };
}

// Draw on the processor: the nearest point of a pixel is seen.
function plainPainter(canvas) {
  // Kept in memory, where it is drawn.
  const ctx = canvas.getContext("2d", { willReadFrequently: true });
  let image = null, pixels = null, depths = null;
  return (cloud, colours, camera) => {
    const width = canvas.width, height = canvas.height;
    if (!image || image.width !== width || image.height !== height) {
      image = ctx.createImageData(width, height);
      pixels = new Uint32Array(image.data.buffer);
      depths = new Float32Array(width * height);
    }
    pixels.fill(word(...rgbOf(color("cloud"))));
    depths.fill(Infinity);
    const big = Math.round(1.5 * (window.devicePixelRatio || 1));
    camera.project(cloud, width, height, (i, px, py, depth) => {
      for (let y = Math.round(py); y < py + big; y++) {
        for (let x = Math.round(px); x < px + big; x++) {
          if (x < 0 || y < 0 || x >= width || y >= height) continue;
          const at = y * width + x;
          if (depth < depths[at]) { depths[at] = depth; pixels[at] = colours[i]; }
        }
      }
    });
    ctx.putImageData(image, 0, 0);
  };
}

// -- camera -------------------------------------------------------------------------------------

// Looks at a target (x, y, z in m) from a distance; along x at yaw 0, down by pitch; z is up.
class Camera {
  constructor() {
    this.focal = 2.1;
    this.aspect = 1;
    this.distance = 1;
    this.target = [0, 0, 0];
    this.turn(-.6, .5);
  }

  turn(yaw, pitch) {
    this.yaw = yaw;
    this.pitch = Math.max(-.3, Math.min(Math.PI / 2, pitch));
    const c = Math.cos(yaw), s = Math.sin(yaw);
    const cp = Math.cos(this.pitch), sp = Math.sin(this.pitch);
    this.right = [s, -c, 0];
    this.up = [c * sp, s * sp, cp];
    this.ahead = [c * cp, s * cp, -sp];
  }

  // Move by shares of the height of the canvas.
  pan(right, up) {
    const far = 2 * this.distance / this.focal;
    this.target = this.target.map((one, k) =>
      one - far * (right * this.right[k] + up * this.up[k]));
  }

  get near() { return Math.max(.02, this.distance * .01); }

  // From the steps of a cloud to clip space, by columns.
  matrix(cloud) {
    const { near, distance } = this;
    const far = distance + 4 * 65535 * cloud.step;
    const rows = [
      this.right.map((one) => one * this.focal / this.aspect),
      this.up.map((one) => one * this.focal),
      this.ahead.map((one) => one * (far + near) / (far - near)),
      this.ahead,
    ];
    const from = cloud.low.map((one, k) => one - this.target[k]);
    const shift = rows.map((row) => row[0] * from[0] + row[1] * from[1] + row[2] * from[2]);
    shift[2] += (distance * (far + near) - 2 * far * near) / (far - near);
    shift[3] += distance;
    return [0, 1, 2].flatMap((k) => rows.map((row) => row[k] * cloud.step)).concat(shift);
  }

  // Call with each point in view: number, pixel x and y, depth in m.
  project(cloud, width, height, call) {
    const m = this.matrix(cloud), { steps } = cloud, { near } = this;
    for (let i = 0, k = 0; i < cloud.shown; i++, k += 3) {
      const a = steps[k], b = steps[k + 1], c = steps[k + 2];
      const depth = m[3] * a + m[7] * b + m[11] * c + m[15];
      if (depth < near) continue;
      const x = (m[0] * a + m[4] * b + m[8] * c + m[12]) / depth;
      const y = (m[1] * a + m[5] * b + m[9] * c + m[13]) / depth;
      call(i, (x + 1) / 2 * width, (1 - y) / 2 * height, depth);
    }
  }

  // The pixel of a place in m, or null behind the camera.
  pixel(place, width, height) {
    const from = place.map((one, k) => one - this.target[k]);
    const along = (axis) => axis[0] * from[0] + axis[1] * from[1] + axis[2] * from[2];
    const depth = this.distance + along(this.ahead);
    if (depth < this.near) return null;
    const scale = this.focal * height / 2 / depth;
    return [width / 2 + scale * along(this.right), height / 2 - scale * along(this.up)];
  }

  // Fill the canvas with the points of a cloud, but for the outermost.
  fit(cloud) {
    const every = 3 * Math.max(1, Math.floor(cloud.shown / 5000));
    const along = [[], [], []];
    for (let k = 0; k < cloud.steps.length; k += every) {
      const from = [0, 1, 2].map((j) =>
        cloud.low[j] + cloud.step * cloud.steps[k + j] - cloud.centre[j]);
      if (Math.hypot(from[0], from[1]) > cloud.view) continue;
      [this.right, this.up, this.ahead].forEach((axis, j) =>
        along[j].push(axis[0] * from[0] + axis[1] * from[1] + axis[2] * from[2]));
    }
    const ends = along.map((values) => {
      values.sort((a, b) => a - b);
      return [.02, .98].map((one) => values[Math.floor(one * (values.length - 1))] || 0);
    });
    const [wide, high, deep] = ends.map(([low, high]) => (high - low) / 2);
    const [right, up, ahead] = ends.map(([low, high]) => (low + high) / 2);
    this.target = cloud.centre.map((one, k) =>
      one + right * this.right[k] + up * this.up[k] + ahead * this.ahead[k]);
    // At the depth of the middle; what is nearer is larger, and lower.
    this.distance = Math.max(.5, this.focal * Math.max(wide / this.aspect, high) * 1.1 + deep * .8);
    const across = [], down = [];
    this.project(cloud, this.aspect, 1, (i, x, y) => {
      if (3 * i % every === 0) { across.push(x); down.push(y); }
    });
    const middle = (values) => {
      values.sort((a, b) => a - b);
      const [low, high] = [.02, .98].map((one) => values[Math.floor(one * (values.length - 1))]);
      return (low + high) / 2 || 0;
    };
    if (down.length) this.pan((this.aspect / 2 - middle(across)) / 2, (middle(down) - .5) / 2);
  }
}

// -- viewer -------------------------------------------------------------------------------------

// Let a canvas show scans. names, poses: of the lidars; say: called with the reason when points are
// drawn without WebGL; isPlayed: many scans per second, which the processor draws several times
// faster without WebGL; spot: place to begin at, with a circle (target, radius and distance of the
// camera in m, yaw). Gives an object with `show(cloud, colouring)`, `fit()`, `above()`, `place()`
// and `draw()`.
function makeViewer(canvas, names, poses, say, isPlayed, spot) {
  const camera = new Camera();
  let base = null, paint = null;
  let cloud = null, colouring = "height", colours = null;
  let pending = false, pointed = null;

  function begin(withGl) {
    if (base) base.remove();
    base = document.createElement("canvas");
    base.setAttribute("aria-hidden", "true");
    canvas.before(base);
    paint = withGl ? glPainter(base, !!isPlayed) : null;
    if (paint) {
      base.addEventListener("webglcontextlost", () => { begin(false); draw(); });
      return;
    }
    // One canvas: without a graphics processor browsers take as long to lay two over each other as
    // to draw the points.
    base.remove();
    paint = plainPainter(canvas);
    say("This browser offers no WebGL" + (isPlayed ? " with a graphics processor" : "") +
      ", so the points are drawn on the processor: slower, and without fading by distance.");
  }

  function drawNow() {
    pending = false;
    const { ctx, width, height } = prepared(canvas);
    if (!cloud || !width || !height) return;
    [base.width, base.height] = [canvas.width, canvas.height];
    camera.aspect = width / height;
    colours = colours || colorsOf(cloud, colouring);
    paint(cloud, colours, camera);
    drawRings(ctx, width, height);
    drawFrames(ctx, width, height);
    if (pointed) drawPointed(ctx, width);
  }

  function draw() {
    if (!pending) requestAnimationFrame(drawNow);
    pending = true;
  }

  function label(ctx, text, x, y, fill) {
    ctx.lineWidth = 4;
    ctx.strokeStyle = color("cloud");
    ctx.strokeText(text, x, y);
    ctx.fillStyle = fill;
    ctx.fillText(text, x, y);
  }

  function drawRing(ctx, [x, y, z], radius, width, height) {
    ctx.beginPath();
    let before = null;
    for (let i = 0; i <= 96; i++) {
      const turn = i / 48 * Math.PI;
      const at = camera.pixel([x + radius * Math.cos(turn), y + radius * Math.sin(turn), z],
        width, height);
      if (at && before) { ctx.moveTo(...before); ctx.lineTo(...at); }
      before = at;
    }
    ctx.stroke();
  }

  // Circles around the body at round distances, and around the spot.
  function drawRings(ctx, width, height) {
    const step = niceStep(camera.distance, 3);
    if (spot) {
      ctx.strokeStyle = color("problem");
      ctx.lineWidth = 2;
      drawRing(ctx, spot.target, spot.radius, width, height);
    }
    ctx.strokeStyle = color("ring");
    ctx.lineWidth = 1;
    for (let k = 1; k <= 4; k++) {
      drawRing(ctx, [0, 0, 0], k * step, width, height);
      const at = camera.pixel([0, -k * step, 0], width, height);
      if (at) label(ctx, +(k * step).toPrecision(3) + " m", at[0] + 3, at[1] - 3, color("soft"));
    }
  }

  // Axes at the body, and at each lidar with its name.
  function drawFrames(ctx, width, height) {
    const frame = (pose, length, wide) => {
      const origin = [pose[3], pose[7], pose[11]];
      const from = camera.pixel(origin, width, height);
      AXES.forEach((stroke, axis) => {
        const to = camera.pixel(origin.map((one, row) => one + length * pose[4 * row + axis]),
          width, height);
        if (!from || !to) return;
        ctx.strokeStyle = stroke;
        ctx.lineWidth = wide;
        ctx.beginPath();
        ctx.moveTo(...from);
        ctx.lineTo(...to);
        ctx.stroke();
      });
      return from;
    };
    const length = camera.distance * .05;
    frame([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0], length, 2.5);
    const labels = [];
    poses.forEach((pose, i) => {
      const at = pose && frame(pose, length * .7, 1.5);
      if (!at) return;
      ctx.fillStyle = sensorColor(i);
      ctx.beginPath();
      ctx.arc(...at, 4, 0, 2 * Math.PI);
      ctx.fill();
      let y = at[1] - 7;
      while (labels.some((one) => Math.abs(one[1] - y) < 13 && Math.abs(one[0] - at[0]) < 70)) {
        y -= 13;
      }
      labels.push([at[0], y]);
      label(ctx, names[i], at[0] + 7, y, color("text"));
    });
  }

  // -- the point under the mouse ------------------------------------------------------------------

  function point(x, y) {
    let best = 14 * 14;
    let found = null, depthOf = Infinity;
    if (cloud) {
      camera.project(cloud, canvas.clientWidth, canvas.clientHeight, (i, px, py, depth) => {
        const away = (px - x) ** 2 + (py - y) ** 2;
        // Of points that cover each other the nearest to the camera.
        if (away < best - 4 || (away < best + 4 && depth < depthOf)) {
          best = Math.min(best, away);
          depthOf = depth;
          found = { i, x: px, y: py };
        }
      });
    }
    if (found || pointed) { pointed = found; draw(); }
  }

  const timeOf = (i) =>
    cloud.times[0] + cloud.time[i] / 65535 * (cloud.times[1] - cloud.times[0]);

  function wordsOf(i) {
    const place = [0, 1, 2].map((k) => cloud.low[k] + cloud.step * cloud.steps[3 * i + k]);
    const pose = cloud.has.lidar ? poses[cloud.lidar[i]] : null;
    const origin = pose ? [pose[3], pose[7], pose[11]] : [0, 0, 0];
    const range = Math.hypot(...place.map((one, k) => one - origin[k]));
    return [
      cloud.has.lidar && names[cloud.lidar[i]],
      cloud.has.ring && "ring " + cloud.ring[i],
      range.toFixed(2) + " m from the " + (pose ? "lidar" : "body"),
      cloud.has.time && (cloud.ages ? (-timeOf(i)).toFixed(2) + " ms old" :
        (timeOf(i) < 0 ? "" : "+") + timeOf(i).toFixed(2) + " ms"),
      place.map((one) => one.toFixed(2)).join(", ") + " m",
    ].filter(Boolean);
  }

  function drawPointed(ctx, width) {
    const lines = wordsOf(pointed.i);
    const wide = Math.max(...lines.map((line) => ctx.measureText(line).width)) + 16;
    const left = Math.max(4, Math.min(pointed.x + 12, width - wide - 4)), top = pointed.y + 10;
    ctx.strokeStyle = color("text");
    ctx.lineWidth = 2;
    ctx.beginPath();
    ctx.arc(pointed.x, pointed.y, 5, 0, 2 * Math.PI);
    ctx.stroke();
    ctx.fillStyle = color("text");
    ctx.fillRect(left, top, wide, lines.length * 16 + 8);
    ctx.fillStyle = color("panel");
    lines.forEach((line, k) => ctx.fillText(line, left + 8, top + 17 + 16 * k));
  }

  // -- mouse, touch, keys -------------------------------------------------------------------------

  const zoom = (factor) => {
    camera.distance = Math.max(.05, Math.min(1e6, camera.distance / factor));
    pointed = null;
    draw();
  };
  const fit = () => { if (cloud) camera.fit(cloud); pointed = null; draw(); };
  const place = () => {
    camera.turn(spot.yaw, .5);
    camera.target = spot.target;
    camera.distance = spot.distance;
    draw();
  };
  const view = (yaw, pitch) => { camera.turn(yaw, pitch); fit(); };

  const fingers = new Map();
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    pointed = null;
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
  }
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) {
      const box = canvas.getBoundingClientRect();
      if (event.pointerType === "mouse") point(event.clientX - box.left, event.clientY - box.top);
      return;
    }
    const now = [event.clientX, event.clientY];
    const right = now[0] - before[0], down = now[1] - before[1];
    const high = canvas.clientHeight;
    const other = [...fingers].find(([id]) => id !== event.pointerId);
    fingers.set(event.pointerId, now);
    if (other) {
      // Two fingers: each moves by half.
      const away = (place) => Math.hypot(place[0] - other[1][0], place[1] - other[1][1]);
      camera.pan(right / high / 2, -down / high / 2);
      zoom(away(now) / Math.max(1, away(before)));
    } else if (event.shiftKey || event.buttons > 1) camera.pan(right / high, -down / high);
    else camera.turn(camera.yaw - right * .008, camera.pitch + down * .006);
    draw();
  });
  canvas.addEventListener("pointerleave", () => { pointed = null; draw(); });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    // A page that is scrolled past the canvas scrolls on, unless the canvas was chosen.
    if (document.activeElement !== canvas && !event.ctrlKey && !document.fullscreenElement) return;
    event.preventDefault();
    zoom(Math.exp(-event.deltaY * .0015));
  }, { passive: false });
  canvas.addEventListener("dblclick", fit);
  canvas.addEventListener("keydown", (event) => {
    const arrow = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const [right, up] = arrow[event.key] || [0, 0];
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    if (arrow[event.key] && event.shiftKey) camera.pan(-right * .08, -up * .08);
    else if (arrow[event.key]) camera.turn(camera.yaw - right * .12, camera.pitch + up * .08);
    else if (event.key === "+" || event.key === "=") zoom(1.2);
    else if (event.key === "-") zoom(1 / 1.2);
    else if (event.key === "f") fit();
    else if (event.key === "t") view(0, Math.PI / 2);
    else return;
    event.preventDefault();
    pointed = null;
    draw();
  });

  begin(true);
  return {
    show(next, how) {
      const isFirst = !cloud;
      if (next !== cloud || how !== colouring) colours = null;
      if (next !== cloud) pointed = null;
      cloud = next;
      colouring = how;
      camera.aspect = canvas.clientWidth / Math.max(1, canvas.clientHeight);
      if (isFirst && spot) place();
      else if (isFirst) camera.fit(cloud);
      drawNow();
    },
    fit, place, above: () => view(0, Math.PI / 2), draw: drawNow,
  };
}
