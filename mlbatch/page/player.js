"use strict";
// Controls of a viewer: play, choice of scans, colours, keys, legend; see the macro `player`.

// data: sensors, poses, begin (number of the first scan to show), play_ms (between two scans),
// ahead (scans to load while playing), is_played and spot (see `makeViewer`), pair (numbers of two
// scans to flip between, instead of playing), colour. load(number): the unpacked
// scan, perhaps later; null after the last; rejected with a reason that the page shows. last(): the
// largest number known. Gives functions: draw again, choose a scan.
function startPlayer(data, load, last) {
  const byId = (id) => document.getElementById(id);
  const canvas = byId("cloud"), slider = byId("scan"), play = byId("play");
  let chosen = 0, colouring = "height", playing = null;
  const why = byId("cloudwhy");
  const say = (text) => { why.textContent = text; why.hidden = false; };
  if (typeof DecompressionStream === "undefined") {
    say("This browser cannot unpack the points (no DecompressionStream): Chrome 103, " +
      "Firefox 113, Safari 16.4 and later can.");
    byId("stage").hidden = true;
    return { draw: () => {}, choose: () => {} };
  }
  const viewer = makeViewer(canvas, data.sensors, data.poses, say, data.is_played, data.spot);
  const isFree = (colour) => !document.querySelector("[data-colour=" + colour + "]").disabled;
  if (data.sensors.length > 1 && isFree("lidar")) colouring = "lidar";
  if (data.colour) colouring = data.colour;

  // The points of a scan; a few of them stay unpacked.
  const loads = new Map();
  function pointsOf(number) {
    if (!loads.has(number)) {
      const loading = Promise.resolve(load(number));
      loads.set(number, loading);
      loading.catch(() => loads.delete(number));
      if (loads.size > 12) loads.delete(loads.keys().next().value);
    }
    return loads.get(number);
  }

  function drawLegend(cloud) {
    const legend = byId("legend");
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
      const [low, high] = cloud.height.map((one) => (Math.round(one * 10) / 10 + 0).toFixed(1));
      item("height " + low + " to " + high + " m", ramp);
    } else if (colouring === "time") {
      const [low, high] = cloud.times.map((one) => Math.round(cloud.ages ? -one : one) + 0);
      item((cloud.ages ? "age " : "time ") + low + " to " + high + " ms", ramp);
    } else item("intensity, 2 % to 98 % of the points", ramp);
  }

  const stop = () => {
    if (playing === null) return;
    clearTimeout(playing);
    playing = null;
    play.textContent = "Play";
  };

  // Show a scan, unless another is chosen before it is loaded; false if there is none.
  async function show(number) {
    const before = chosen;
    chosen = number;
    const waiting = setTimeout(() => {
      byId("cloudinfo").textContent = "Loading scan " + number + " ...";
    }, 500);
    let cloud = null;
    try {
      cloud = await pointsOf(number);
    } catch (err) {
      stop();
      say(err.message);
    }
    clearTimeout(waiting);
    if (chosen !== number) return true;
    slider.max = last();
    if (!cloud) { chosen = before; return false; }
    viewer.show(cloud, colouring);
    slider.value = number;
    slider.setAttribute("aria-valuetext", cloud.title);
    byId("cloudinfo").textContent = cloud.title + ": " + cloud.text;
    drawLegend(cloud);
    document.querySelectorAll("[data-colour]").forEach((button) => {
      button.setAttribute("aria-pressed", button.dataset.colour === colouring);
    });
    document.querySelectorAll("[data-scan]").forEach((button) => {
      button.setAttribute("aria-pressed", Number(button.dataset.scan) === number);
    });
    document.documentElement.dataset.shown = number;
    return true;
  }

  async function step() {
    const due = performance.now() + data.play_ms;
    const isShown = await show(chosen + 1);
    // After the last scan from the first on.
    if (!isShown && playing !== null && !await show(0)) stop();
    if (playing === null) return;
    for (let k = 1; k <= data.ahead; k++) pointsOf(chosen + k);
    playing = setTimeout(step, Math.max(0, due - performance.now()));
  }

  // The scan to flip back to.
  let other = data.begin;
  const flip = () => {
    const last = data.pair[1];
    if (chosen !== last) other = chosen;
    show(chosen === last ? other : last);
  };
  const toggle = () => {
    if (data.pair) { flip(); return; }
    if (playing !== null) { stop(); return; }
    play.textContent = "Pause";
    playing = setTimeout(step, 0);
  };
  const choose = async (number) => {
    stop();
    // After the last scan the last one, once it is known which that is.
    if (!await show(Math.max(0, number)) && last() < number) show(last());
  };
  const colour = (name) => { colouring = name; show(chosen); };
  document.querySelectorAll("[data-colour]").forEach((button) => {
    button.addEventListener("click", () => colour(button.dataset.colour));
  });
  document.querySelectorAll("[data-scan]").forEach((button) => {
    button.addEventListener("click", () => choose(Number(button.dataset.scan)));
  });
  // Scans that are made on demand are not made for each step of the slider.
  let sliding = null;
  slider.addEventListener("input", () => {
    clearTimeout(sliding);
    sliding = setTimeout(() => choose(Number(slider.value)), data.is_played ? 150 : 0);
  });
  play.addEventListener("click", toggle);
  byId("fit").addEventListener("click", viewer.fit);
  if (byId("spot")) {
    byId("spot").hidden = !data.spot;
    byId("spot").addEventListener("click", viewer.place);
  }
  byId("above").addEventListener("click", viewer.above);
  byId("full").addEventListener("click", () => {
    if (document.fullscreenElement) document.exitFullscreen();
    else byId("viewer").requestFullscreen();
  });
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    if (event.key === " ") toggle();
    else if (event.key === "p" && data.spot) viewer.place();
    else if (event.key === "." || event.key === ",") choose(chosen + (event.key === "." ? 1 : -1));
    else if (event.key === "c") {
      const names = [...document.querySelectorAll("[data-colour]:enabled")]
        .map((button) => button.dataset.colour);
      colour(names[(names.indexOf(colouring) + 1) % names.length]);
    } else return;
    event.preventDefault();
  });
  new ResizeObserver(viewer.draw).observe(canvas);
  show(data.begin);
  return { draw: viewer.draw, choose };
}
