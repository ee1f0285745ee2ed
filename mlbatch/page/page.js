// Plots and scans of a run, or clouds of a comparison; the data are in the element `data`, see
// document.py and instant.py.
(function () {
  const data = JSON.parse(document.getElementById("data").textContent);
  const byId = (id) => document.getElementById(id);
  const tip = byId("tip");
  const redraws = [];

  function unpack(packed) {
    if (!packed || packed.type === "none") return null;
    const Kind = { u1: Uint8Array, u2: Uint16Array, u4: Uint32Array }[packed.type];
    const words = new Kind(bytesOf(packed.data).buffer);
    if (packed.step === undefined) return words;
    const values = new Float32Array(words.length);
    for (let i = 0; i < words.length; i++) {
      values[i] = words[i] === 65535 ? NaN : packed.low + words[i] * packed.step;
    }
    return values;
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
    let begun = null, isDragged = false;
    const stepOf = (event) => {
      const box = canvas.getBoundingClientRect();
      const share = Math.max(0, Math.min(1, (event.clientX - box.left) / box.width));
      return view.from + share * (view.to - view.from);
    };
    canvas.addEventListener("pointerdown", (event) => {
      if (event.pointerType === "mouse") begun = { step: stepOf(event), x: event.clientX };
    });
    window.addEventListener("pointerup", (event) => {
      isDragged = Boolean(begun) && Math.abs(event.clientX - begun.x) > 6;
      if (isDragged) {
        const end = stepOf(event);
        setView(Math.min(begun.step, end), Math.max(begun.step, end));
      }
      begun = null;
    });
    canvas.addEventListener("click", (event) => { if (!isDragged) showNearest(stepOf(event)); });
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
  }

  function sayRange() {
    const digits = stepS < 1 ? 1 : 0;
    byId("range").textContent = timeText(view.from * stepS, digits) + " to " +
      timeText(view.to * stepS, digits);
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

  // floor: least height of the axis, so that noise is no cliff; 0: an axis from 0.
  function drawLines(canvas, series, colors, floor) {
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
    if (!floor) low = Math.min(0, low);
    const pad = Math.max((high - low) * .08, (floor - (high - low)) / 2) || 1;
    if (floor) low -= pad;
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

  // -- scans ------------------------------------------------------------------------------------

  const clouds = data.clouds;
  let player = null;
  if (clouds.length) {
    player = startPlayer(data, (number) =>
      number < clouds.length ? unpackCloud(clouds[number]) : null, () => clouds.length - 1);
    redraws.push(player.draw);
  }

  // Show the scan of the page that is nearest to a step.
  function showNearest(step) {
    const away = clouds.map((one) => Math.abs(one.middle - step));
    if (player) player.choose(away.indexOf(Math.min(...away)));
  }

  // -- start ------------------------------------------------------------------------------------

  if (win && byId("range")) {
    const one = (values, id, unit, floor) => addTimePlot(id,
      (canvas) => drawLines(canvas, [values], [color("note")], floor),
      (row) => values && !Number.isNaN(values[row]) ? values[row].toFixed(unit ? 3 : 0) + unit
        : "not recorded");
    timePlots.push(sayRange);
    redraws.push(sayRange);
    addTimePlot("timeline", drawTimeline, describeFill(40));
    addTimePlot("gap",
      (canvas) => drawLines(canvas, rows.gap, rows.gap.map((_, i) => sensorColor(i)), 0),
      (row) => rows.gap.map((values, i) => win.sensors[i] + ": " +
        (values && !Number.isNaN(values[row]) ? values[row].toFixed(3) + " ms" : "none"))
        .join("\n"));
    one(rows.points, "points", "", 0);
    one(rows.span, "span", " ms", win.floors.span);
    one(rows.delay, "delay", " ms", win.floors.delay);
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
  const drawAll = () => {
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
