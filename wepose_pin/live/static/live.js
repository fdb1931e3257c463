const data = JSON.parse($("wepose-data").textContent);
const TRAIL_S = 3, TRAIL_WIDTH = 0.013, TRAIL_POINTS = 240;              // [s], [m]
const LOST = { colour: 0x8a929b, opacity: 0.4 };
const RETRY_MS = [300, 1000, 2000];
const n = data.links.length;

// ---- the scene
const stage = $("stage");
const viewer = openViewer(stage);
const body = buildScene(viewer, data.scene, data.links);
const skins = body.map((link) => {
  const found = [];
  link.traverse(({ material }) => { if (material) found.push([material, material.color.getHex(), material.opacity]); });
  return found;
});
const darkScreen = matchMedia("(prefers-color-scheme: dark)");
const backdrop = (name) => setBackdrop(viewer, data.backdrops[name]);
const screenBackdrop = () => backdrop(darkScreen.matches ? "dark" : "light");
darkScreen.addEventListener("change", screenBackdrop);
screenBackdrop();

// ---- one frame: time [s], of each link R_WL row by row and p_WL, the points of trails, of each link whether its sensor
// is lost
const matrix = new THREE.Matrix4();
const paths = data.trails.map(() => []);
const ribbons = data.trails.map(({ colour }) => new Ribbon(viewer, colour, TRAIL_POINTS, TRAIL_S, TRAIL_WIDTH));
let now = NaN, trailsShown = true, frames = 0;
const shownLost = new Uint8Array(n);

function pose(buffer) {
  const before = now;
  now = new DataView(buffer).getFloat64(0, true);
  const v = new Float32Array(buffer, 8, 12 * n + 3 * paths.length), lost = new Uint8Array(buffer, 8 + 4 * v.length, n);
  body.forEach((link, k) => {
    const a = 12 * k;
    link.visible = isFinite(v[a] + v[a + 9]);                            // NaN: not known
    if (!link.visible) return;
    matrix.set(v[a], v[a + 1], v[a + 2], 0, v[a + 3], v[a + 4], v[a + 5], 0, v[a + 6], v[a + 7], v[a + 8], 0, 0, 0, 0, 1);
    link.quaternion.setFromRotationMatrix(matrix);
    link.position.fromArray(v, a + 9);
    if (lost[k] !== shownLost[k]) {
      shownLost[k] = lost[k];
      skins[k].forEach(([material, colour, opacity]) => {
        material.color.setHex(lost[k] ? LOST.colour : colour);
        material.opacity = lost[k] ? LOST.opacity : opacity;
        material.transparent = material.opacity < 1;
        material.needsUpdate = true;
      });
    }
  });
  paths.forEach((path, k) => {
    if (!(now > before)) path.length = 0;                                // the start, or a replay begins anew
    if (!isFinite(now)) return;
    path.push([now, new THREE.Vector3().fromArray(v, 12 * n + 3 * k)]);
    let old = Math.max(path.length - TRAIL_POINTS, 0);
    while (old < path.length && path[old][0] < now - TRAIL_S) old++;
    path.splice(0, old);
  });
  frames++;
  drawnAt = performance.now();
}

// ---- the camera
const fit = () => fitCamera(viewer, stage, data.view, 80);
let moved = false;                                                       // by the user: then a resize leaves it alone
viewer.controls.addEventListener("start", () => { moved = true; });
new ResizeObserver(() => { viewer.set_3d_pane_size(); if (!moved) fit(); }).observe(stage);

// ---- words
const SHAPES = { there: "M5 1a4 4 0 1 0 .01 0z", moving: "M1 0l9 5-9 5z", static: "M1 1h8v8H1z", lost: "M0 2l2-2 3 3 3-3 2 2-3 3 3 3-2 2-3-3-3 3-2-2 3-3z" };
const SAYS = { waiting: "Waiting", start_pose: "Stand still", moved: "Moved – again", ready: "Live", ended: "Ended" };
const known = (value, digits) => (value === null ? "–" : value.toFixed(digits).replace("-", "−"));
const words = (name) => name.replaceAll("_", " ");
function duration(s) {
  if (s === null) return "–";
  if (s < 60) return `${Math.floor(s)} s`;
  return s < 3600 ? `${Math.floor(s / 60)} min` : `${(s / 3600).toFixed(1)} h`;
}
function text(parent, tag, content, title) {
  const element = document.createElement(tag);
  element.textContent = content;
  if (title) element.title = title;
  parent.append(element);
  return element;
}
function shape(name) {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
  svg.setAttribute("viewBox", "0 0 10 10");
  path.setAttribute("d", SHAPES[name]);
  svg.append(path);
  return svg;
}
function small(id, value, unit) {
  $(id).textContent = value;
  text($(id), "small", unit);
}

let state = "";
function show(status) {
  state = status.state;
  const begun = state === "ready" || state === "ended";                  // before, nothing is estimated
  $("say").className = `${begun ? "small" : ""} ${state}`;
  $("say").querySelector("strong").textContent = SAYS[state] ?? state;
  $("say").querySelector("span").textContent = status.message;
  $("progress").querySelector("i").style.width = `${100 * status.progress}%`;
  $("progress").hidden = state === "waiting";
  $("rows").replaceChildren(...status.sensors.map((sensor) => {
    const row = document.createElement("tr");
    const is = sensor.lost ? "lost" : !begun ? "there" : sensor.static ? "static" : "moving";
    if (sensor.lost) row.className = "lost";
    text(row, "td", words(sensor.segment));
    text(row, "td", sensor.frozen ? "frozen" : is).prepend(shape(is));
    text(row, "td", known(sensor.rate_hz, 0));
    text(row, "td", sensor.bias_deg_s.map((axis) => known(begun ? axis : null, 2).padStart(5, "\u2007")).join(" "));
    text(row, "td", known(sensor.heading_std_deg, 1));
    text(row, "td", duration(begun ? sensor.heading_age_s : null));
    text(row, "td", sensor.missing + sensor.late + sensor.duplicate,
         `never came: ${sensor.missing}, too late: ${sensor.late}, twice: ${sensor.duplicate}`);
    return row;
  }));
  const [half, most] = status.latency_ms;
  if (begun) small("latency", `${known(half, 1)} ms`, ` median, ${known(most, 1)} ms in 99 of 100`);
  else $("latency").textContent = "–";
  small("time", `${known(status.time, 1)} s`, " of the source's clock");
  $("recording").textContent = status.recorded_s ? `${status.recorded_s.toFixed(1)} s in the file` : "none";
  if (status.recorded_s) $("recording").prepend(document.createElement("b"));
  const problems = Object.entries(status.problems).filter(([, count]) => count);
  $("problems").hidden = $("problems-name").hidden = !problems.length;
  $("problems").textContent = problems.map(([name, count]) => `${name}: ${count}`).join(", ");
}
data.trails.forEach(({ name, colour }) => {
  text($("legend"), "span", words(name)).prepend(Object.assign(document.createElement("i"), { style: `background: ${colour}` }));
});
text($("legend"), "span", "sensor lost").prepend(Object.assign(document.createElement("i"), { className: "lost" }));

// ---- the line: nothing more comes until what came is drawn
let socket, tries = 0, owed = 0, newestStatus = null, newestFrame = null, drawnAt = performance.now();
function connect() {
  socket = new WebSocket(`ws://${location.host}/stream`);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => { tries = 0; owed = 0; $("offline").hidden = true; };
  socket.onmessage = ({ data: message }) => {
    owed++;
    if (typeof message !== "string") { newestFrame = message; return; }
    const said = JSON.parse(message);
    if ("state" in said) newestStatus = said;
    else if (said.id !== data.id) location.reload();                     // another session at the same address
  };
  socket.onclose = () => {
    const ended = (newestStatus?.state ?? state) === "ended";
    $("offline").textContent = ended ? "The session has ended. This page waits for the next one."
                                     : "Connection lost: what you see is old. Trying again …";
    $("offline").hidden = false;
    setTimeout(connect, RETRY_MS[Math.min(tries++, RETRY_MS.length - 1)]);
  };
}

function press(key) {
  const through = socket.readyState === WebSocket.OPEN;
  if (through) socket.send(`key ${key}`);
  $("answer").textContent = !through ? "Not connected: nothing was asked for."
    : state === "ready" ? "Asked for new headings." : "Headings are set when the start pose has been held.";
  setTimeout(() => { $("answer").textContent = ""; }, 4000);
}
function toggleTrails() {
  trailsShown = !trailsShown;
  $("trails").setAttribute("aria-pressed", trailsShown);
  viewer.set_dirty();
}
$("reset").addEventListener("click", () => press("r"));
$("trails").addEventListener("click", toggleTrails);
$("camera").addEventListener("click", () => { moved = false; fit(); });
addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
  if (event.key !== " " && event.key.toLowerCase() !== "r") return;
  event.preventDefault();
  press("r");
});
addEventListener("keyup", (event) => {                                   // space would press a focused button, too
  if (event.key === " ") event.preventDefault();
});

// ---- the loop
function draw() {
  const eye = viewer.scene.worldToLocal(viewer.camera.position.clone());
  ribbons.forEach((ribbon, k) => {
    ribbon.mesh.visible = trailsShown && paths[k].length > 1;
    if (ribbon.mesh.visible) ribbon.draw(paths[k], now, eye);
  });
  viewer.render();
}
function tick() {
  requestAnimationFrame(tick);
  if (newestStatus) { show(newestStatus); newestStatus = null; }
  if (newestFrame) { pose(newestFrame); newestFrame = null; viewer.set_dirty(); }
  if (viewer.needs_render) draw();
  for (; owed > 0 && socket.readyState === WebSocket.OPEN; owed--) socket.send("taken");
}
let counted = 0;
setInterval(() => {
  const silent = (performance.now() - drawnAt) / 1000;
  if (!isFinite(now)) small("picture", "the start pose", "");
  else if (silent > 1.5) small("picture", `${duration(silent)} old`, ": no new pose comes");
  else small("picture", `${frames - counted}`, " a second");
  counted = frames;
}, 1000);
addEventListener("beforeprint", () => {                                  // on paper a canvas would be as it last was on screen
  backdrop("light");
  draw();
  $("printed").src = viewer.renderer.domElement.toDataURL();
});
addEventListener("afterprint", screenBackdrop);

window.wepose = { frames: () => frames, time: () => now, state: () => state };
viewer.set_3d_pane_size();
fit();
connect();
requestAnimationFrame(tick);
