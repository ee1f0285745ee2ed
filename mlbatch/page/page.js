"use strict";
// Plots of a run; the data are in the element `data`, see document.py.
(function () {
  const data = JSON.parse(document.getElementById("data").textContent);
  const byId = (id) => document.getElementById(id);
  const tip = byId("tip");
  const PALETTE = ["#2f7ed8", "#e8743b", "#19a979", "#945ecf", "#d9a404", "#ed4a7b", "#13a4b4",
    "#6c8893"];
  const redraws = [];
  let style = getComputedStyle(document.documentElement);
  const color = (name) => style.getPropertyValue("--" + name).trim();
  const sensorColor = (i) => PALETTE[i % PALETTE.length];

  function unpack(packed) {
    if (!packed || packed.type === "none") return null;
    const text = atob(packed.data);
    const bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    const Kind = { u1: Uint8Array, u2: Uint16Array, u4: Uint32Array }[packed.type];
    const words = new Kind(bytes.buffer);
    if (packed.step === undefined) return words;
    const values = new Float32Array(words.length);
    for (let i = 0; i < words.length; i++) {
      values[i] = words[i] === 65535 ? NaN : packed.low + words[i] * packed.step;
    }
    return values;
  }

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
    const factor = [1, 2, 5, 10].find((one) => one * power >= raw);
    return factor * power;
  }

  function digitsOf(step) {
    return Math.max(0, Math.min(6, -Math.floor(Math.log10(step) + 1e-9)));
  }

  function timeText(seconds, digits) {
    return "+" + seconds.toFixed(digits) + " s";
  }

  // -- time axis, shared by all plots of windows ------------------------------------------------

  const win = data.windows;
  const rows = win && {
    step: unpack(win.step), count: unpack(win.count), incomplete: unpack(win.incomplete),
    points: unpack(win.points), span: unpack(win.span), delay: unpack(win.delay),
    columns: win.columns.map(unpack), expected: win.expected.map(unpack),
    fill: win.fill.map(unpack), gap: win.gap.map(unpack), coverage: win.coverage.map(unpack),
  };
  const total = rows ? rows.step[rows.step.length - 1] + rows.count[rows.count.length - 1] : 1;
  const view = { from: 0, to: total };
  const stepS = win ? win.period_ms / 1000 : 1;
  const timePlots = [];
  let framePending = false;

  function setView(from, to) {
    const least = Math.min(total, 4);
    const span = Math.max(least, Math.min(total, to - from));
    from = Math.max(0, Math.min(total - span, (from + to - span) / 2));
    view.from = from;
    view.to = from + span;
    if (framePending) return;
    framePending = true;
    requestAnimationFrame(() => { framePending = false; timePlots.forEach((draw) => draw()); });
  }

  // First row at or after a step.
  function rowAt(step) {
    let low = 0, high = rows.step.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (rows.step[middle] < step) low = middle + 1; else high = middle;
    }
    return low;
  }

  // Row whose windows contain a step, or -1 where there is no scan.
  function rowOf(step) {
    const row = rowAt(Math.floor(step) + 1) - 1;
    if (row < 0) return -1;
    const end = row + 1 < rows.step.length ? rows.step[row + 1] : total;
    const reach = win.group > 1 ? end : rows.step[row] + 1;
    return step < reach ? row : -1;
  }

  // Rows of each pixel column: [first, end), empty where there is no scan.
  function pixelRows(width) {
    const found = [];
    const perPixel = (view.to - view.from) / width;
    for (let x = 0; x < width; x++) {
      const begin = view.from + x * perPixel;
      const first = rowOf(begin);
      const end = rowAt(begin + perPixel);
      const start = first >= 0 ? first : rowAt(begin);
      found.push(start < end ? [start, end] : first >= 0 ? [first, first + 1] : [0, 0]);
    }
    return found;
  }

  function timeAxis(ctx, width, top, bottom) {
    const from = view.from * stepS, to = view.to * stepS;
    const step = niceStep(to - from, width / 90);
    const digits = digitsOf(step);
    ctx.fillStyle = color("soft");
    ctx.strokeStyle = color("grid");
    ctx.lineWidth = 1;
    for (let t = Math.ceil(from / step - 1e-9) * step; t <= to + 1e-9; t += step) {
      const x = (t - from) / (to - from) * width;
      ctx.beginPath();
      ctx.moveTo(Math.round(x) + .5, top);
      ctx.lineTo(Math.round(x) + .5, bottom);
      ctx.stroke();
      const text = timeText(Math.max(0, t), digits);
      const half = ctx.measureText(text).width / 2;
      ctx.fillText(text, Math.max(0, Math.min(width - 2 * half, x - half)), bottom + 13);
    }
  }

  function addTimePlot(id, draw, describe) {
    const canvas = byId(id);
    if (!canvas) return;
    const redraw = () => draw(canvas);
    timePlots.push(redraw);
    redraws.push(redraw);
    let begun = null;
    const stepOf = (event) => {
      const box = canvas.getBoundingClientRect();
      const share = Math.max(0, Math.min(1, (event.clientX - box.left) / box.width));
      return view.from + share * (view.to - view.from);
    };
    canvas.addEventListener("pointerdown", (event) => {
      if (event.pointerType === "mouse") begun = { step: stepOf(event), x: event.clientX };
    });
    window.addEventListener("pointerup", (event) => {
      if (begun && Math.abs(event.clientX - begun.x) > 6) {
        const end = stepOf(event);
        setView(Math.min(begun.step, end), Math.max(begun.step, end));
      }
      begun = null;
    });
    canvas.addEventListener("dblclick", () => setView(0, total));
    canvas.addEventListener("pointermove", (event) => {
      const step = stepOf(event);
      const row = rowOf(step);
      const head = timeText(step * stepS, stepS < 1 ? 2 : 0);
      showTip(event, row < 0 ? head + "\nno scan" : head + "  " + nameOf(row) + "\n" +
        describe(row, event.clientY - canvas.getBoundingClientRect().top));
    });
    canvas.addEventListener("pointerleave", () => { tip.hidden = true; });
  }

  function nameOf(row) {
    const slices = Math.max(1, win.slices);
    const number = rows.step[row] + win.first_index * slices;
    const name = "scan " + Math.floor(number / slices);
    const flag = rows.incomplete[row] ? "  incomplete" : "";
    return win.group > 1 ? name + " and " + (rows.count[row] - 1) + " more" + flag : name + flag;
  }

  function showTip(event, text) {
    tip.textContent = text;
    tip.hidden = false;
    const left = Math.min(event.pageX + 14, window.scrollX + document.documentElement.clientWidth -
      tip.offsetWidth - 8);
    tip.style.left = Math.max(4, left) + "px";
    tip.style.top = event.pageY + 16 + "px";
  }

  function share(value) {
    return (100 * value).toFixed(value > .999 || value < .001 ? 0 : 1) + " %";
  }

  // -- lanes of sensors -------------------------------------------------------------------------

  const LABEL = 16;

  function lanes(canvas, laneHeight, drawPixel) {
    const count = win.sensors.length;
    const size = prepared(canvas, count * (laneHeight + LABEL) + 23);
    const ctx = size.ctx;
    const bottom = size.height - 18;
    timeAxis(ctx, size.width, 0, bottom);
    const width = Math.floor(size.width);
    const pixels = pixelRows(width);
    for (let i = 0; i < count; i++) {
      const top = i * (laneHeight + LABEL) + LABEL;
      ctx.fillStyle = sensorColor(i);
      ctx.fillRect(0, top - 11, 9, 9);
      ctx.fillStyle = color("text");
      ctx.fillText(win.sensors[i], 14, top - 3);
      ctx.fillStyle = color("none");
      ctx.fillRect(0, top, width, laneHeight);
      for (let x = 0; x < width; x++) {
        if (pixels[x][1] > pixels[x][0]) drawPixel(ctx, i, x, top, pixels[x]);
      }
    }
  }

  function lowestFill(i, range) {
    let low = 1;
    for (let row = range[0]; row < range[1]; row++) low = Math.min(low, rows.fill[i][row]);
    return low;
  }

  function drawTimeline(canvas) {
    const high = 40;
    const bar = color("bar"), missing = color("missing");
    lanes(canvas, high, (ctx, i, x, top, range) => {
      const fill = lowestFill(i, range);
      // A single missing column is visible, too.
      const red = fill < 1 ? Math.max(3, (1 - fill) * high) : 0;
      ctx.fillStyle = bar;
      ctx.fillRect(x, top + red, 1, high - red);
      if (!red) return;
      ctx.fillStyle = missing;
      ctx.fillRect(x, top, 1, red);
    });
    // Incomplete scans, below all lanes.
    const ctx = canvas.getContext("2d");
    ctx.fillStyle = color("warning");
    const y = win.sensors.length * (high + LABEL) + 1;
    pixelRows(Math.floor(canvas.clientWidth)).forEach((range, x) => {
      for (let row = range[0]; row < range[1]; row++) {
        if (rows.incomplete[row]) { ctx.fillRect(x, y, 1, 3); break; }
      }
    });
    const digits = stepS < 1 ? 1 : 0;
    byId("range").textContent = timeText(view.from * stepS, digits) + " to " +
      timeText(view.to * stepS, digits);
  }

  const RAMP = [[0, 165, 0, 38], [.25, 244, 109, 67], [.6, 254, 224, 139], [.97, 116, 173, 209],
    [1, 43, 108, 176]];

  function rampOf(value) {
    let k = 1;
    while (k < RAMP.length - 1 && value > RAMP[k][0]) k++;
    const a = RAMP[k - 1], b = RAMP[k];
    const s = Math.max(0, Math.min(1, (value - a[0]) / (b[0] - a[0])));
    const part = (j) => Math.round(a[j] + s * (b[j] - a[j]));
    return "rgb(" + part(1) + "," + part(2) + "," + part(3) + ")";
  }

  function drawFill(canvas) {
    const high = 18;
    lanes(canvas, high, (ctx, i, x, top, range) => {
      ctx.fillStyle = rampOf(lowestFill(i, range));
      ctx.fillRect(x, top, 1, high);
    });
  }

  function laneAt(y, high) {
    return Math.max(0, Math.min(win.sensors.length - 1, Math.floor(y / (high + LABEL))));
  }

  function describeFill(high) {
    return (row, y) => {
      const i = laneAt(y, high);
      const covered = rows.coverage[i] ? "\nrotor coverage " + share(rows.coverage[i][row]) : "";
      return win.sensors[i] + ": " + rows.columns[i][row] + " of " + rows.expected[i][row] +
        " columns, fill " + share(rows.fill[i][row]) + covered;
    };
  }

  // -- lines over time --------------------------------------------------------------------------

  function drawLines(canvas, series, colors, fromZero) {
    const size = prepared(canvas, 120);
    const ctx = size.ctx, bottom = size.height - 18, top = 6;
    timeAxis(ctx, size.width, top, bottom);
    const width = Math.floor(size.width);
    const pixels = pixelRows(width);
    let low = Infinity, high = -Infinity;
    for (const values of series) {
      if (!values) continue;
      for (let x = 0; x < width; x++) {
        for (let row = pixels[x][0]; row < pixels[x][1]; row++) {
          if (values[row] < low) low = values[row];
          if (values[row] > high) high = values[row];
        }
      }
    }
    if (high === -Infinity) {
      ctx.fillStyle = color("soft");
      ctx.fillText("not recorded in scans.csv", 10, (top + bottom) / 2);
      return;
    }
    if (fromZero) low = Math.min(0, low);
    const pad = (high - low) * .08 || Math.max(1, Math.abs(high) * .1);
    if (!fromZero) low -= pad;
    high += pad;
    const yOf = (value) => bottom - (value - low) / (high - low) * (bottom - top);
    const label = valueAxis(ctx, size.width, low, high, yOf);
    series.forEach((values, i) => {
      if (!values) return;
      ctx.strokeStyle = colors[i];
      ctx.fillStyle = colors[i];
      ctx.lineWidth = 1.4;
      const columnWidth = width / (view.to - view.from);
      let last = null;
      ctx.beginPath();
      for (let x = 0; x < width; x++) {
        let least = Infinity, most = -Infinity;
        for (let row = pixels[x][0]; row < pixels[x][1]; row++) {
          if (values[row] < least) least = values[row];
          if (values[row] > most) most = values[row];
        }
        if (most === -Infinity) { last = null; continue; }
        if (last === null) ctx.moveTo(x, yOf(least)); else ctx.lineTo(x, yOf(least));
        if (most > least) ctx.lineTo(x, yOf(most));
        if (last === null) ctx.lineTo(x + Math.min(1, columnWidth), yOf(most));
        last = most;
      }
      ctx.stroke();
    });
    label();
  }

  // Draw the lines of an axis; gives a function that labels them, for when the data are drawn.
  function valueAxis(ctx, width, low, high, yOf) {
    const step = niceStep(high - low, 3);
    const digits = digitsOf(step);
    const labels = [];
    for (let v = Math.ceil(low / step) * step; v <= high; v += step) {
      const text = Math.abs(v) >= 1e6 ? (v / 1e6).toFixed(1) + " M" :
        Math.abs(v) >= 1e4 ? (v / 1e3).toFixed(0) + " k" : v.toFixed(digits);
      labels.push([text, Math.max(12, yOf(v) - 3)]);
      ctx.strokeStyle = color("grid");
      ctx.lineWidth = 1;
      ctx.beginPath();
      ctx.moveTo(0, Math.round(yOf(v)) + .5);
      ctx.lineTo(width, Math.round(yOf(v)) + .5);
      ctx.stroke();
    }
    return () => labels.forEach(([text, y]) => {
      ctx.globalAlpha = .85;
      ctx.fillStyle = color("panel");
      ctx.fillRect(0, y - 10, ctx.measureText(text).width + 8, 13);
      ctx.globalAlpha = 1;
      ctx.fillStyle = color("soft");
      ctx.fillText(text, 4, y);
    });
  }

  // -- clocks -----------------------------------------------------------------------------------

  function drawDrift(canvas) {
    const size = prepared(canvas, 170);
    const ctx = size.ctx, bottom = size.height - 20, top = 8;
    const span = data.recorded_s;
    const ends = data.drift_ppm.map((ppm) => ppm === null ? null : ppm * span / 1000);
    const known = ends.filter((end) => end !== null);
    let low = Math.min(0, ...known), high = Math.max(0, ...known);
    const pad = (high - low) * .12 || 1;
    low -= pad;
    high += pad;
    const right = size.width - 8;
    const yOf = (value) => bottom - (value - low) / (high - low) * (bottom - top);
    valueAxis(ctx, size.width, low, high, yOf)();
    const step = niceStep(span, size.width / 90);
    ctx.fillStyle = color("soft");
    for (let t = 0; t <= span; t += step) {
      const text = timeText(t, digitsOf(step));
      const x = t / span * right;
      ctx.fillText(text, Math.min(x, size.width - ctx.measureText(text).width), bottom + 14);
    }
    const labels = [];
    ends.forEach((end, i) => {
      if (end === null) return;
      ctx.strokeStyle = sensorColor(i);
      ctx.lineWidth = 2;
      ctx.beginPath();
      ctx.moveTo(0, yOf(0));
      ctx.lineTo(right, yOf(end));
      ctx.stroke();
      labels.push({ y: yOf(end), i, text: data.sensors[i] + "  " + (end < 0 ? "" : "+") +
        end.toFixed(3) + " ms" });
    });
    labels.sort((a, b) => a.y - b.y);
    labels.forEach((one, k) => {
      one.y = Math.max(one.y - 6, k ? labels[k - 1].y + 14 : 14);
    });
    const over = labels.length ? labels[labels.length - 1].y - (bottom - 4) : 0;
    labels.forEach((one) => {
      const y = over > 0 ? one.y - over : one.y;
      const x = right - ctx.measureText(one.text).width - 6;
      ctx.lineWidth = 4;
      ctx.strokeStyle = color("panel");
      ctx.strokeText(one.text, x, y);
      ctx.fillStyle = sensorColor(one.i);
      ctx.fillText(one.text, x, y);
    });
  }

  // -- clouds -----------------------------------------------------------------------------------

  const clouds = data.clouds.map((one) => {
    const words = unpack(one.xyz);
    const xyz = new Float32Array(words.length);
    for (let i = 0; i < words.length; i++) {
      xyz[i] = one.low[i % 3] + words[i] / 65535 * one.size;
    }
    return { ...one, xyz, lidar: unpack(one.lidar), time: unpack(one.time),
      bright: unpack(one.bright) };
  });
  // One centre and one scale for all, so that scans compare.
  const filled = clouds.filter((one) => one.xyz.length);
  const centre = [0, 1, 2].map((k) =>
    filled.reduce((sum, one) => sum + one.centre[k] / filled.length, 0));
  const radius = Math.max(1, ...filled.map((one) => one.view +
    Math.hypot(one.centre[0] - centre[0], one.centre[1] - centre[1])));
  let chosen = 0;
  let colouring = "height";
  const poses = data.poses.map((pose) => pose);

  // Opaque colours as 32-bit words of an ImageData.
  const word = (r, g, b) => (255 << 24 | b << 16 | g << 8 | r) >>> 0;
  const hex = (text) => word(parseInt(text.slice(1, 3), 16), parseInt(text.slice(3, 5), 16),
    parseInt(text.slice(5, 7), 16));
  const SCALE = [[68, 60, 150], [49, 104, 180], [33, 145, 150], [70, 180, 90], [215, 185, 40],
    [235, 110, 50]];
  const SCALE_WORDS = new Uint32Array(256);
  for (let i = 0; i < 256; i++) {
    const at = i / 255 * (SCALE.length - 1);
    const k = Math.min(SCALE.length - 2, Math.floor(at));
    const part = (j) => Math.round(SCALE[k][j] + (at - k) * (SCALE[k + 1][j] - SCALE[k][j]));
    SCALE_WORDS[i] = word(part(0), part(1), part(2));
  }

  function colorsOf(cloud) {
    const found = new Uint32Array(cloud.xyz.length / 3);
    const [low, high] = cloud.height;
    const span = high > low ? high - low : 1;
    for (let i = 0; i < found.length; i++) {
      if (colouring === "lidar") found[i] = hex(sensorColor(cloud.lidar[i]));
      else if (colouring === "height") {
        const share = (cloud.xyz[3 * i + 2] - low) / span;
        found[i] = SCALE_WORDS[Math.round(255 * Math.max(0, Math.min(1, share)))];
      } else found[i] = SCALE_WORDS[cloud[colouring][i]];
    }
    return found;
  }

  // Draw points through `project(x, y, z) -> [pixel x, pixel y, depth]`; the nearest one is seen.
  function splat(ctx, cloud, colors, project, big) {
    const width = ctx.canvas.width, height = ctx.canvas.height;
    const image = ctx.createImageData(width, height);
    const pixels = new Uint32Array(image.data.buffer);
    const depths = new Float32Array(width * height).fill(Infinity);
    const out = [0, 0, 0];
    for (let i = 0; i < colors.length; i++) {
      project(cloud.xyz[3 * i], cloud.xyz[3 * i + 1], cloud.xyz[3 * i + 2], out);
      const px = Math.round(out[0]), py = Math.round(out[1]);
      for (let dy = 0; dy < big; dy++) {
        for (let dx = 0; dx < big; dx++) {
          const x = px + dx, y = py + dy;
          if (x < 0 || y < 0 || x >= width || y >= height) continue;
          const at = y * width + x;
          if (out[2] < depths[at]) { depths[at] = out[2]; pixels[at] = colors[i]; }
        }
      }
    }
    ctx.putImageData(image, 0, 0);
  }

  function drawAxes(ctx, project, scale, length) {
    const line = (from, to, stroke, wide) => {
      const a = [0, 0, 0], b = [0, 0, 0];
      project(from[0], from[1], from[2], a);
      project(to[0], to[1], to[2], b);
      ctx.strokeStyle = stroke;
      ctx.lineWidth = wide;
      ctx.beginPath();
      ctx.moveTo(a[0] / scale, a[1] / scale);
      ctx.lineTo(b[0] / scale, b[1] / scale);
      ctx.stroke();
    };
    const AXES = ["#e23b3b", "#2fa84f", "#3b7de2"];
    const frame = (pose, size, wide) => {
      const origin = [pose[3], pose[7], pose[11]];
      for (let axis = 0; axis < 3; axis++) {
        const tipOf = [0, 1, 2].map((row) => origin[row] + size * pose[4 * row + axis]);
        line(origin, tipOf, AXES[axis], wide);
      }
      return origin;
    };
    frame([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0], length, 2.5);
    const labels = [];
    poses.forEach((pose, i) => {
      if (!pose) return;
      const origin = frame(pose, length * .7, 1.5);
      const at = [0, 0, 0];
      project(origin[0], origin[1], origin[2], at);
      const x = at[0] / scale, y = at[1] / scale;
      ctx.fillStyle = sensorColor(i);
      ctx.beginPath();
      ctx.arc(x, y, 4, 0, 2 * Math.PI);
      ctx.fill();
      let ly = y - 7;
      while (labels.some((one) => Math.abs(one.y - ly) < 13 && Math.abs(one.x - x) < 70)) ly -= 13;
      labels.push({ x, y: ly });
      ctx.lineWidth = 4;
      ctx.strokeStyle = color("cloud");
      ctx.strokeText(data.sensors[i], x + 7, ly);
      ctx.fillStyle = color("text");
      ctx.fillText(data.sensors[i], x + 7, ly);
    });
  }

  function drawTop(canvas) {
    const number = Number(canvas.dataset.scan);
    const cloud = clouds[number];
    const size = prepared(canvas);
    const scale = canvas.width / size.width;
    const zoom = canvas.width / 2 / (radius * 1.08);
    const half = canvas.width / 2;
    // x up, y left; what is higher hides what is lower.
    const project = (x, y, z, out) => {
      out[0] = half - (y - centre[1]) * zoom;
      out[1] = half - (x - centre[0]) * zoom;
      out[2] = -z;
    };
    splat(size.ctx, cloud, colorsOf(cloud), project, Math.round(Math.max(1, scale)));
    const step = niceStep(2 * radius, 4);
    size.ctx.strokeStyle = color("line");
    size.ctx.lineWidth = 1;
    size.ctx.globalCompositeOperation = "destination-over";
    for (let k = -6; k <= 6; k++) {
      const at = Math.round((half + k * step * zoom) / scale) + .5;
      size.ctx.beginPath();
      size.ctx.moveTo(at, 0);
      size.ctx.lineTo(at, size.height);
      size.ctx.moveTo(0, at);
      size.ctx.lineTo(size.width, at);
      size.ctx.stroke();
    }
    size.ctx.globalCompositeOperation = "source-over";
    drawAxes(size.ctx, project, scale, radius * .08);
    const bar = step * zoom / scale;
    size.ctx.fillStyle = color("soft");
    size.ctx.fillRect(8, size.height - 10, bar, 2);
    size.ctx.lineWidth = 4;
    size.ctx.strokeStyle = color("cloud");
    size.ctx.strokeText(step + " m", 8, size.height - 15);
    size.ctx.fillText(step + " m", 8, size.height - 15);
    canvas.classList.toggle("chosen", number === chosen);
  }

  const camera = { yaw: -.6, pitch: .55, zoom: 1, moved: false };

  function drawCloud(canvas) {
    const cloud = clouds[chosen];
    const size = prepared(canvas);
    const scale = canvas.width / size.width;
    const middle = [canvas.width / 2, canvas.height * .55];
    const distance = radius * 1.8 / camera.zoom;
    const focal = canvas.height * 1.05;
    const cosYaw = Math.cos(camera.yaw), sinYaw = Math.sin(camera.yaw);
    const cosPitch = Math.cos(camera.pitch), sinPitch = Math.sin(camera.pitch);
    // Camera behind the centre, looking along x at yaw 0; z is up.
    const project = (x, y, z, out) => {
      const dx = x - centre[0], dy = y - centre[1], dz = z - centre[2];
      const ahead = dx * cosYaw + dy * sinYaw;
      const left = -dx * sinYaw + dy * cosYaw;
      const depth = distance + ahead * cosPitch - dz * sinPitch;
      const up = ahead * sinPitch + dz * cosPitch;
      const factor = depth > .05 ? focal / depth : NaN;
      out[0] = middle[0] - left * factor;
      out[1] = middle[1] - up * factor;
      out[2] = depth;
    };
    splat(size.ctx, cloud, cloudColors, project, Math.round(Math.max(1, scale * 1.5)));
    drawAxes(size.ctx, project, scale, radius * .08);
  }

  let cloudColors = null;

  function drawClouds() {
    cloudColors = colorsOf(clouds[chosen]);
    document.querySelectorAll("canvas.top").forEach(drawTop);
    drawCloud(byId("cloud"));
    const away = Math.hypot(...centre);
    byId("cloudinfo").textContent = "Drawn: the " + clouds[chosen].title + "." +
      (away ? " The centre of the views is " + away.toFixed(0) + " m from the body." : "");
    drawLegend();
    document.querySelectorAll("button[data-colour]").forEach((button) => {
      button.classList.toggle("chosen", button.dataset.colour === colouring);
    });
  }

  function drawLegend() {
    const legend = byId("legend");
    const cloud = clouds[chosen];
    legend.textContent = "";
    const item = (text, background) => {
      const span = document.createElement("span");
      const mark = document.createElement("i");
      mark.style.background = background;
      if (background.startsWith("linear")) mark.style.width = "90px";
      span.append(mark, text);
      legend.append(span);
    };
    const ramp = "linear-gradient(90deg," +
      SCALE.map((c) => "rgb(" + c.join(",") + ")").join(",") + ")";
    if (colouring === "lidar") data.sensors.forEach((name, i) => item(name, sensorColor(i)));
    else if (colouring === "height") {
      // Plus zero: no sign of a rounded zero.
      item("height " + (Math.round(cloud.height[0] * 10) / 10 + 0).toFixed(1) + " to " + cloud.height[1].toFixed(1) + " m",
        ramp);
    } else if (colouring === "time") item("time 0 to " + cloud.window_ms.toFixed(0) + " ms", ramp);
    else item("intensity, 2 % to 98 % of the points", ramp);
  }

  function startClouds() {
    if (!clouds.length) return;
    const canvas = byId("cloud");
    if (data.sensors.length > 1 &&
      !document.querySelector("button[data-colour=lidar]").disabled) colouring = "lidar";
    document.querySelectorAll("button[data-colour]").forEach((button) => {
      button.addEventListener("click", () => { colouring = button.dataset.colour; drawClouds(); });
    });
    document.querySelectorAll("canvas.top").forEach((top) => {
      const choose = () => { chosen = Number(top.dataset.scan); drawClouds(); };
      top.addEventListener("click", choose);
      top.addEventListener("keydown", (event) => { if (event.key === "Enter") choose(); });
    });
    let last = null;
    canvas.addEventListener("pointerdown", (event) => {
      last = [event.clientX, event.clientY];
      camera.moved = true;
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!last) return;
      camera.yaw -= (event.clientX - last[0]) * .008;
      camera.pitch += (event.clientY - last[1]) * .006;
      camera.pitch = Math.max(-.2, Math.min(1.55, camera.pitch));
      last = [event.clientX, event.clientY];
      requestAnimationFrame(() => drawCloud(canvas));
    });
    canvas.addEventListener("pointerup", () => { last = null; });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      camera.moved = true;
      camera.zoom = Math.max(.2, Math.min(30, camera.zoom * Math.exp(-event.deltaY * .0015)));
      requestAnimationFrame(() => drawCloud(canvas));
    }, { passive: false });
    redraws.push(drawClouds);
    if (matchMedia("(prefers-reduced-motion: reduce)").matches) return;
    let visible = false;
    new IntersectionObserver((found) => {
      const was = visible;
      visible = found[found.length - 1].isIntersecting;
      if (visible && !was) requestAnimationFrame(turn);
    }).observe(canvas);
    let before = 0;
    const turn = (now) => {
      if (!visible || camera.moved) return;
      if (now - before > 40) {
        camera.yaw += Math.min(.05, (now - before) * .0002);
        before = now;
        drawCloud(canvas);
      }
      requestAnimationFrame(turn);
    };
  }

  // -- start ------------------------------------------------------------------------------------

  if (win) {
    const one = (values, id, unit, fromZero) => addTimePlot(id,
      (canvas) => drawLines(canvas, [values], [color("note")], fromZero),
      (row) => values && !Number.isNaN(values[row]) ? values[row].toFixed(unit ? 3 : 0) + unit
        : "not recorded");
    addTimePlot("timeline", drawTimeline, describeFill(40));
    addTimePlot("fill", drawFill, describeFill(18));
    addTimePlot("gap",
      (canvas) => drawLines(canvas, rows.gap, rows.gap.map((_, i) => sensorColor(i)), true),
      (row) => rows.gap.map((values, i) => win.sensors[i] + ": " +
        (values && !Number.isNaN(values[row]) ? values[row].toFixed(3) + " ms" : "none"))
        .join("\n"));
    one(rows.points, "points", "", true);
    one(rows.span, "span", " ms", false);
    one(rows.delay, "delay", " ms", false);
    const zoom = (factor) => {
      const middle = (view.from + view.to) / 2, half = (view.to - view.from) / 2 * factor;
      setView(middle - half, middle + half);
    };
    const move = (share) => {
      const by = (view.to - view.from) * share;
      setView(view.from + by, view.to + by);
    };
    byId("in").addEventListener("click", () => zoom(.5));
    byId("out").addEventListener("click", () => zoom(2));
    byId("back").addEventListener("click", () => move(-.5));
    byId("on").addEventListener("click", () => move(.5));
    byId("all").addEventListener("click", () => setView(0, total));
  }
  if (byId("drift")) redraws.push(() => drawDrift(byId("drift")));
  startClouds();
  const drawAll = () => {
    style = getComputedStyle(document.documentElement);
    drawnWidth = document.body.clientWidth;
    redraws.forEach((draw) => draw());
  };
  let resizing = null;
  let drawnWidth = 0;
  new ResizeObserver(() => {
    clearTimeout(resizing);
    // Scroll bars change the width without an event of the window.
    if (document.body.clientWidth !== drawnWidth) resizing = setTimeout(drawAll, 60);
  }).observe(document.body);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawAll);
  drawAll();
  // For tests: the page is drawn, in ms since it was opened.
  document.documentElement.dataset.drawn = Math.round(performance.now());
})();
