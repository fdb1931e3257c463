const data = JSON.parse($("wepose-data").textContent);
const TRAIL_S = 3, TRAIL_WIDTH = 0.013;                                  // [s], [m]
const SPEEDS = [0.25, 0.5, 1, 2, 4];
const BAND_COLOURS = ["#a9cbe8", "#f1cf8f", "#aed8ae", "#dbb6dc", "#efb3a4", "#a5d9d6", "#cfc9a8"];

// ---- the scene
const stage = $("stage");
const viewer = openViewer(stage);
const body = buildScene(viewer, data.scene, data.links);
setBackdrop(viewer, BACKDROPS.light, data.floor);

// ---- the motion: frame k is at times[k], a link's frame is quaternion xyzw and position
const times = floats(data.offsets), motion = floats(data.motion), n = times.length;
const span = data.end - data.begin;
let now = 0, playing = true, speed = 1, trailsShown = true;              // now: [s] since the recording's begin

function frameAt(t) {                                                    // the last frame at or before t
  let low = 0, high = n - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (times[middle] <= t) low = middle; else high = middle - 1;
  }
  return low;
}

const q = new THREE.Quaternion(), p = new THREE.Vector3();
function pose(t) {
  const k = frameAt(t), next = Math.min(k + 1, n - 1);
  const share = next > k ? Math.min(Math.max((t - times[k]) / (times[next] - times[k]), 0), 1) : 0;
  body.forEach((link, index) => {
    const a = 7 * (index * n + k), b = 7 * (index * n + next);
    link.quaternion.fromArray(motion, a);
    link.position.fromArray(motion, a + 4);
    link.visible = isFinite(link.quaternion.x + link.position.x);        // NaN: not known here
    if (link.visible && share > 0 && isFinite(motion[b] + motion[b + 4])) {
      link.quaternion.slerp(q.fromArray(motion, b), share);
      link.position.lerp(p.fromArray(motion, b + 4), share);
    }
  });
}

// ---- trails of the last seconds
class Trail {
  constructor({ points, colour }) {
    this.points = floats(points);
    let most = 2;                                                        // frames that TRAIL_S ever spans, and the end
    for (let k = 0, first = 0; k < n; k++) {
      while (times[k] - times[first] > TRAIL_S) first++;
      most = Math.max(most, k - first + 3);
    }
    this.ribbon = new Ribbon(viewer, colour, most, TRAIL_S, TRAIL_WIDTH);
  }

  at(k) { return new THREE.Vector3().fromArray(this.points, 3 * k); }

  draw(t, eye) {
    this.ribbon.mesh.visible = trailsShown;
    if (!trailsShown) return;
    const last = frameAt(t), next = Math.min(last + 1, n - 1), path = [];
    for (let k = frameAt(t - TRAIL_S); k <= last; k++) {
      if (times[k] >= t - TRAIL_S) path.push([times[k], this.at(k)]);
    }
    if (next > last) {
      path.push([t, this.at(last).lerp(this.at(next), (t - times[last]) / (times[next] - times[last]))]);
    }
    this.ribbon.draw(path, t, eye);
  }
}
const trails = data.trails.map((trail) => new Trail(trail));

// ---- the camera
const VIEWS = { Front: [1, 0, 0.05], Side: [0, -1, 0.05], Top: [-0.001, 0, 1] };   // from where, in W
let from = CAMERA_FROM;
const fit = () => fitCamera(viewer, stage, data.view, 80, from);
let moved = false;                                                       // by the user: then a resize leaves it alone
viewer.controls.addEventListener("start", () => { moved = true; });
new ResizeObserver(() => { viewer.set_3d_pane_size(); if (!moved) fit(); }).observe(stage);

// ---- the bar
const ICONS = { play: "M3 1l9 6-9 6z", pause: "M2 1h3.6v12H2zM8.4 1H12v12H8.4z" };
const slider = $("slider");
slider.max = span || 1;
const digits = span < 100 ? 2 : 1;
$("total").textContent = (data.begin ? `s of ${data.begin.toFixed(digits)} to ` : "/ ") + `${data.end.toFixed(digits)} s`;
const share = (t) => `${span ? 100 * Math.min(Math.max(t / span, 0), 1) : 0}%`;
data.phases.forEach(({ name, spans }, i) => spans.forEach(([a, b]) => {
  if (b < data.begin || a > data.end) return;
  const band = document.createElement("span");
  band.textContent = name.replaceAll("_", " ");
  band.title = `${name}: ${a.toFixed(2)} to ${b.toFixed(2)} s`;
  const left = Math.max(a - data.begin, 0), width = Math.min(b - data.begin, span) - left;
  Object.assign(band.style, { left: share(left), width: share(width), background: BAND_COLOURS[i % BAND_COLOURS.length] });
  $("bands").append(band);
}));
data.trails.forEach(({ name, colour }) => {
  const entry = document.createElement("span"), swatch = document.createElement("i");
  swatch.style.background = colour;
  entry.append(swatch, name.replaceAll("_", " "));
  $("legend").append(entry);
});
SPEEDS.forEach((value) => {
  const button = document.createElement("button");
  button.textContent = `${value}×`;
  button.addEventListener("click", () => { speed = value; show(); });
  $("speeds").append(button);
});
$("trails").hidden = trails.length === 0;
Object.entries(VIEWS).forEach(([name, direction]) => {
  const button = document.createElement("button");
  button.textContent = name;
  button.addEventListener("click", () => { from = direction; moved = false; fit(); });
  $("views").append(button);
});
const angles = data.angles.map(({ name, values }) => {
  const row = $("angles").insertRow();
  row.insertCell().textContent = name;
  return { values: floats(values), cell: row.insertCell() };
});
$("anglesShown").hidden = angles.length === 0;

function show() {
  pose(now);
  const k = frameAt(now);
  angles.forEach(({ values, cell }) => { cell.textContent = isFinite(values[k]) ? `${Math.round(values[k])}°` : "–"; });
  slider.value = now;
  slider.setAttribute("aria-valuetext", `${(data.begin + now).toFixed(digits)} s`);
  $("past").style.width = share(now);
  $("now").textContent = (data.begin + now).toFixed(digits);
  $("play").querySelector("path").setAttribute("d", playing ? ICONS.pause : ICONS.play);
  [...$("speeds").children].forEach((button, i) => button.setAttribute("aria-pressed", SPEEDS[i] === speed));
  $("trails").setAttribute("aria-pressed", trailsShown);
  viewer.set_dirty();
}
const api = {
  ready: false,
  time: () => data.begin + now,
  seek(t) { now = Math.min(Math.max(t - data.begin, 0), span); show(); },
  play() { playing = true; show(); },
  pause() { playing = false; show(); },
  playing: () => playing,
};
window.wepose = api;

function step(seconds) { api.pause(); api.seek(api.time() + seconds); }
const frame = n > 1 ? span / (n - 1) : 0;
$("play").addEventListener("click", () => (playing ? api.pause() : api.play()));
$("trails").addEventListener("click", () => { trailsShown = !trailsShown; show(); });
$("anglesShown").addEventListener("click", () => {
  $("angles").hidden = !$("angles").hidden;
  $("anglesShown").setAttribute("aria-pressed", !$("angles").hidden);
});
$("reset").addEventListener("click", () => { from = CAMERA_FROM; moved = false; fit(); });
slider.addEventListener("input", () => { now = Number(slider.value); show(); });
addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.key === " ") playing ? api.pause() : api.play();
  else if (event.key === "ArrowLeft") step(event.shiftKey ? -1 : -frame);
  else if (event.key === "ArrowRight") step(event.shiftKey ? 1 : frame);
  else return;
  event.preventDefault();
});
addEventListener("keyup", (event) => {                                   // space would press a focused button, too
  if (event.key === " ") event.preventDefault();
});

function readHash() {
  const words = new URLSearchParams(location.hash.slice(1));
  const t = parseFloat(words.get("t"));
  if (!isFinite(t)) return;
  playing = words.has("play");
  api.seek(t);
}
addEventListener("hashchange", readHash);

// ---- the loop
let before = null;
function tick(at) {
  requestAnimationFrame(tick);
  if (playing && before !== null && span > 0) {
    now += Math.min((at - before) / 1000, 0.25) * speed;                 // a hidden tab does not jump ahead
    if (now > span) now %= span;
    show();
  }
  before = at;
  if (!viewer.needs_render) return;
  const eye = viewer.scene.worldToLocal(viewer.camera.position.clone());
  trails.forEach((trail) => trail.draw(now, eye));
  viewer.render();
  if (!api.ready) {
    api.ready = true;
    document.documentElement.dataset.weposeReady = "true";
  }
}
viewer.set_3d_pane_size();
fit();
show();
readHash();
requestAnimationFrame(tick);
