const data = JSON.parse($("wepose-data").textContent);
const TRAIL_S = 3, TRAIL_WIDTH = 0.013, TRAIL_POINTS = 240;              // [s], [m]
const LOST = { colour: 0x8a929b, opacity: 0.4 };
const RETRY_MS = [300, 1000, 2000];
const n = data.links.length;

// ---- the scene
const stage = $("stage");
const viewer = openViewer(stage);
const body = buildScene(viewer, data.scene, data.links);
body.forEach((link) => { link.visible = false; });                        // until the first frame places them
const skins = body.map((link) => {
  const found = [];
  link.traverse(({ material }) => { if (material) found.push([material, material.color.getHex(), material.opacity]); });
  return found;
});
const darkScreen = matchMedia("(prefers-color-scheme: dark)");
const backdrop = (name) => setBackdrop(viewer, BACKDROPS[name], data.floor);
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
const fit = () => fitCamera(viewer, stage, data.view, 48);
let moved = false;                                                       // by the user: then a resize leaves it alone
viewer.controls.addEventListener("start", () => { moved = true; });
new ResizeObserver(() => {                                               // a resized canvas is empty until it is drawn
  viewer.set_3d_pane_size();
  if (!moved) fit();
  draw();
}).observe(stage);

// ---- words
const SHAPES = { there: "M5 1a4 4 0 1 0 .01 0z", moving: "M1 0l9 5-9 5z", static: "M1 1h8v8H1z", lost: "M0 2l2-2 3 3 3-3 2 2-3 3 3 3-2 2-3-3-3 3-2-2 3-3z" };
const SAYS = { waiting: "Waiting", start_pose: "Stand still", moved: "Moved – again", ready: "Live", ended: "Ended" };
const known = (value, digits) => (value === null ? "–" : value.toFixed(digits).replace("-", "−"));
const words = (name) => name.replaceAll("_", " ");
const degrees = (angle) => (angle === null ? null : angle * 180 / Math.PI);
const UNKNOWN_HEADING = Math.PI / Math.sqrt(3);                          // [rad] of a direction that is uniform on the circle
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

// ---- what the person may ask for: actions that are offered, by buttons and keys
let actions = [], guideActions = [], shownActions = "";
function ask(action, text = "") {
  const through = socket.readyState === WebSocket.OPEN;
  if (through) socket.send(JSON.stringify({ action, text }));
  return through;
}
function press({ name, label }, typed) {
  const through = ask(name, typed);
  $("answer").textContent = !through ? "Not connected: nothing was asked for." : guided ? "" : `${label}: asked for.`;
  setTimeout(() => { $("answer").textContent = ""; }, 3000);
}
function control(action) {
  const form = document.createElement("form"), button = text(form, "button", `${action.label} `);
  text(button, "kbd", action.key.toUpperCase());
  button.dataset.action = action.name;
  if (action.is_on) button.setAttribute("aria-pressed", "true");
  if (action.entry) {
    const label = document.createElement("label");
    text(label, "span", action.entry);
    label.append(Object.assign(document.createElement("input"), { maxLength: 120, placeholder: action.entry }));
    form.prepend(label);
  }
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    press(action, form.querySelector("input")?.value.trim());
    form.reset();
  });
  return form;
}
function showActions() {
  const offered = guided ? guideActions : actions;                       // steps to repeat are a list of their own
  const shown = JSON.stringify([guided, offered]);
  if (shown === shownActions) return;                                    // a button stays while it is pressed, a text while it is typed
  shownActions = shown;
  $("actions").replaceChildren(...offered.filter(({ entry }) => guided && !entry).map(control));
  $("controls").replaceChildren(...offered.filter(({ entry }) => !guided || entry).map(control));
}

// ---- the guided session
let guided = false, guideSays = "", spokenCount = null, voice = false;
function speak(what) {
  if (!voice || !what) return;
  speechSynthesis.cancel();
  speechSynthesis.speak(new SpeechSynthesisUtterance(what));
}
function showGuide(guide) {
  guided = guide !== null;
  guideActions = guide?.actions ?? [];
  document.body.classList.toggle("guided", guided);
  $("steps").hidden = $("result").hidden = guide === null;
  $("note").hidden = !guide?.note;
  if (guide === null) return;
  $("note").textContent = guide.note;
  $("steps").replaceChildren(...guide.steps.map(({ name, title, state }) => {
    const item = Object.assign(document.createElement("li"), { className: state });
    const inner = text(item, state === "done" ? "button" : "span", title);   // to repeat it
    if (state === "done") inner.addEventListener("click", () => ask(name));
    if (state === "now") item.setAttribute("aria-current", "step");
    return item;
  }));
  const now = guide.steps.find((step) => step.state === "now"), count = guide.countdown;
  const left = guide.remaining === null ? "" : ` · ${known(guide.remaining, 0)} s`;
  $("say").querySelector("strong").textContent = count === null ? now.title + left : Math.ceil(count);
  $("say").classList.toggle("counting", count !== null);
  showResult(guide);
  if (guideSays !== guide.note + guide.sentence) speak(guide.note || guide.sentence);
  else if (count !== null && count <= 3.2 && Math.ceil(count) !== spokenCount) speak(String(Math.ceil(count)));
  guideSays = guide.note + guide.sentence;
  spokenCount = count === null ? null : Math.ceil(count);
}
const QUALITY = { "": "So far", pass: "✓ Good", poor: "! Usable", fail: "✕ Not usable" };
function showResult(guide) {
  const lengths = Object.entries(guide.lengths);
  $("result").hidden = !lengths.length && !guide.reasons.length;
  $("quality").textContent = QUALITY[guide.quality];
  $("quality").className = guide.quality;
  $("reasons").replaceChildren();
  guide.reasons.forEach((reason) => text($("reasons"), "p", reason));
  $("lengths").querySelector("tbody").replaceChildren(...lengths.map(([name, [metres, std]]) => {
    const row = document.createElement("tr"), mm = (value, digits) => known(value === null ? null : 1e3 * value, digits);
    text(row, "td", words(name));
    text(row, "td", `${mm(metres, 0)} mm`);
    text(row, "td", `± ${mm(std, 0)} mm`);
    const bar = text(text(row, "td", "", "the uncertainty: shorter is better"), "i", "");
    bar.style.width = `${Math.min(100, 2500 * std)}%`;
    return row;
  }));
}
let state = "";
function show(status) {
  state = status.state;
  actions = status.actions;
  const begun = state === "ready" || state === "ended";                  // before, nothing is estimated
  $("say").className = `${begun ? "small" : ""} ${state}`;
  $("say").querySelector("strong").textContent = SAYS[state] ?? state;
  $("say").querySelector("span").textContent = status.message;
  showGuide(status.guide);
  showActions();
  $("progress").querySelector("i").style.width = `${100 * status.progress}%`;
  $("progress").hidden = state === "waiting";
  $("rows").replaceChildren(...status.sensors.map((sensor) => {
    const row = document.createElement("tr");
    const is = sensor.lost ? "lost" : !begun ? "there" : sensor.static ? "static" : "moving";
    if (sensor.lost) row.className = "lost";
    text(row, "td", words(sensor.segment));
    const place = text(row, "td", sensor.frozen ? "frozen" : is);
    place.prepend(shape(is));
    text(row, "td", known(sensor.rate_hz, 0));
    text(row, "td", sensor.gyro_bias.map((axis) => known(begun ? degrees(axis) : null, 2).padStart(5, "\u2007")).join(" ")).className = "detail";
    text(row, "td", sensor.heading_std > UNKNOWN_HEADING ? "unknown" : known(degrees(sensor.heading_std), 1)).className = "detail";
    text(row, "td", known(sensor.missing, 0));
    return row;
  }));
  const [half, most] = status.latency_ms;
  if (begun) small("latency", `${known(half, 1)} ms`, ` median, ${known(most, 1)} ms in 99 of 100`);
  else $("latency").textContent = "–";
  small("time", `${known(status.time, 1)} s`, " of the source's clock");
  $("recording").textContent = status.recorded_s ? `${status.recorded_s.toFixed(1)} s in the file` : "none";
  if (status.recorded_s && state !== "ended") $("recording").prepend(document.createElement("b"));
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
  socket = new WebSocket(`ws://${location.host}/stream${location.search}`);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => { tries = 0; owed = 0; $("offline").hidden = true; };
  socket.onmessage = ({ data: message }) => {
    owed++;
    if (typeof message !== "string") { newestFrame = message; return; }
    const said = JSON.parse(message);
    if (!("state" in said)) { if (said.id !== data.id) location.reload(); return; }    // another session at the same address
    newestStatus = said;
  };
  socket.onclose = () => {
    const ended = (newestStatus?.state ?? state) === "ended";
    $("offline").textContent = ended ? "The session has ended. This page waits for the next one."
                                     : "Connection lost: what you see is old. Trying again …";
    $("offline").hidden = false;
    setTimeout(connect, RETRY_MS[Math.min(tries++, RETRY_MS.length - 1)]);
  };
}

$("trails").addEventListener("click", () => {
  trailsShown = !trailsShown;
  $("trails").setAttribute("aria-pressed", trailsShown);
  viewer.set_dirty();
});
$("voice").addEventListener("click", () => {
  voice = !voice;
  $("voice").setAttribute("aria-pressed", voice);
  if (voice) speak("Voice on"); else speechSynthesis.cancel();
});
$("details").addEventListener("click", () => {
  $("details").setAttribute("aria-pressed", document.body.classList.toggle("detailed"));
});
$("camera").addEventListener("click", () => { moved = false; fit(); });
addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
  if (event.target instanceof HTMLInputElement) return;
  const key = event.key.toLowerCase(), action = key === " " ? actions[0] : actions.find((each) => each.key === key);
  if (!action) return;
  const input = document.querySelector(`[data-action="${action.name}"]`)?.form.querySelector("input");
  if (input) input.focus(); else press(action);
  event.preventDefault();
});
addEventListener("keyup", (event) => {                                   // space would press a focused button, too
  if (event.key === " " && !(event.target instanceof HTMLInputElement)) event.preventDefault();
});

// ---- the loop
function draw() {
  const eye = viewer.scene.worldToLocal(viewer.camera.position.clone());
  ribbons.forEach((ribbon, k) => {
    ribbon.mesh.visible = trailsShown && !guided && paths[k].length > 1;
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
  if (!isFinite(now)) small("picture", "–", " before tracking");
  else if (silent > 1.5) small("picture", `${duration(silent)} old`, ": no new pose comes");
  else small("picture", `${frames - counted}`, " drawn in the last second");
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
