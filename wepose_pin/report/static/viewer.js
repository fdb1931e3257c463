// What the page of a recording and the live page share: meshcat's viewer in a box, ribbons, the camera.
const THREE = MeshCat.THREE;
const $ = (id) => document.getElementById(id);
const CAMERA_FROM = [2.1, 1.25, 0.55];                                   // from the person in W: front-left, slightly above
const FIELD_OF_VIEW_DEG = 28;                                            // a long lens: near hands do not look larger
const LIGHTS = [                                                         // meshcat's own: intensity, position in W [m]
  ["AmbientLight", 0.66], ["FillLight", 0.20],
  ["PointLightNegativeX", 0.50, [2.5, 2.0, 2.6]], ["PointLightPositiveX", 0.16, [1.0, -3.0, 1.0]],
];
const BACKDROPS = {                                                      // red, green, blue behind the body
  light: { top: [0.985, 0.99, 0.995], bottom: [0.89, 0.91, 0.935], grid: [0.70, 0.74, 0.79] },
  dark: { top: [0.085, 0.105, 0.130], bottom: [0.135, 0.160, 0.190], grid: [0.30, 0.34, 0.39] },
};

function bytes(base64) {
  const text = atob(base64), out = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) out[i] = text.charCodeAt(i);
  return out;
}

function openViewer(stage) {
  let viewer;
  try {
    viewer = new MeshCat.Viewer(stage, false);                           // false: the page's loop draws
  } catch (error) {
    stage.insertAdjacentHTML("beforeend", '<p id="trouble">This browser offers no WebGL, which the picture needs.</p>');
    throw error;
  }
  const resize = viewer.set_3d_pane_size.bind(viewer);                   // meshcat takes the window's height
  viewer.set_3d_pane_size = () => resize(stage.clientWidth, stage.clientHeight);
  return viewer;
}

const floats = (base64) => new Float32Array(bytes(base64).buffer);

// Lights, camera and body; gives the group of each link, which the page moves.
function buildScene(viewer, scene, links) {
  viewer.set_property(["Axes"], "visible", false);
  viewer.set_property(["Grid"], "visible", false);
  viewer.set_property(["Cameras", "default", "rotated", "<object>"], "fov", FIELD_OF_VIEW_DEG);
  LIGHTS.forEach(([name, intensity, position]) => {
    viewer.set_property(["Lights", name], "visible", true);
    viewer.set_property(["Lights", name, "<object>"], "intensity", intensity);
    if (position) viewer.set_property(["Lights", name, "<object>"], "position", position);
  });
  const shapes = {
    box: ([x, y, z]) => new THREE.BoxGeometry(x, y, z),
    sphere: ([radius]) => new THREE.SphereGeometry(radius, 40, 28),
    cylinder: ([radius, length]) => new THREE.CylinderGeometry(radius, radius, length, 50).rotateX(Math.PI / 2), // along z
  };
  const add = (link, name, geometry, [red, green, blue, opacity], more) => {
    const clipped = [red, green, blue].map((c) => Math.round(255 * Math.min(Math.max(c, 0), 1)));
    const color = (clipped[0] << 16) + (clipped[1] << 8) + clipped[2];
    const material = new THREE.MeshPhongMaterial(
      { color, opacity, transparent: opacity !== 1, specular: 0x1c1c1c, shininess: 24, ...more });
    const mesh = new THREE.Mesh(geometry, material);
    mesh.castShadow = mesh.receiveShadow = true;
    viewer.set_object(["meshcat", "body", String(link), name], mesh);
    return mesh;
  };
  scene.parts.forEach(({ link, kind, size, quat, position, rgba }, k) => {
    const mesh = add(link, `part${k}`, shapes[kind](size), rgba);
    mesh.quaternion.fromArray(quat);
    mesh.position.fromArray(position);
  });
  scene.meshes.forEach(({ link, vertices, triangles, rgba }, k) => {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(floats(vertices), 3));
    geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(bytes(triangles).buffer), 1));
    geometry.computeVertexNormals();
    add(link, `mesh${k}`, geometry, rgba, { flatShading: true, side: THREE.DoubleSide });
  });
  return links.map((_, k) => viewer.scene_tree.find(["meshcat", "body", String(k)]).object);
}

// Background and ground grid, which fades into it, in place of those before.
const GRID_CELL = 0.25, GRID_RADIUS = 3;                                 // [m]
function setBackdrop(viewer, { top, bottom, grid }, floor) {           // floor: height of the ground in W [m]
  viewer.set_property(["Background"], "top_color", top);
  viewer.set_property(["Background"], "bottom_color", bottom);
  const points = [], colours = [];
  const add = (x, y) => {
    const share = Math.min(Math.hypot(x, y) / GRID_RADIUS, 1);
    points.push(x, y, floor);
    colours.push(...grid.map((near, k) => near + share * (bottom[k] - near)));
  };
  for (let a = -GRID_RADIUS; a <= GRID_RADIUS; a += GRID_CELL) {
    for (let b = -GRID_RADIUS; b < GRID_RADIUS; b += GRID_CELL) {
      add(a, b); add(a, b + GRID_CELL); add(b, a); add(b + GRID_CELL, a);
    }
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(points, 3));
  geometry.setAttribute("color", new THREE.Float32BufferAttribute(colours, 3));
  viewer.set_object(["meshcat", "ground"], new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ vertexColors: true })));
  viewer.set_dirty();
}

// A trail that faces the camera, as WebGL draws lines one pixel wide.
class Ribbon {
  constructor(viewer, colour, most, seconds, width) {                    // most: points it ever has; width: [m]
    this.colour = new THREE.Color(colour);
    this.seconds = seconds;
    this.width = width;
    this.position = new THREE.BufferAttribute(new Float32Array(6 * most), 3);
    this.rgba = new THREE.BufferAttribute(new Float32Array(8 * most), 4);
    this.index = new THREE.BufferAttribute(new Uint32Array(6 * most), 1);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", this.position);
    geometry.setAttribute("color", this.rgba);
    geometry.setIndex(this.index);
    const material = new THREE.MeshBasicMaterial({ vertexColors: true, transparent: true, depthWrite: false,
                                                   side: THREE.DoubleSide });
    this.mesh = new THREE.Mesh(geometry, material);
    this.mesh.frustumCulled = false;
    viewer.scene.add(this.mesh);
  }

  draw(path, now, eye) {                                                 // path: [time [s], Vector3], NaN: a gap
    let corners = 0;
    const known = ([, point]) => isFinite(point.x + point.y + point.z);
    path.forEach(([time, point], i) => {
      const before = path[Math.max(i - 1, 0)][1], after = path[Math.min(i + 1, path.length - 1)][1];
      const fresh = Math.max(1 - (now - time) / this.seconds, 0);
      const side = after.clone().sub(before).cross(eye.clone().sub(point)).normalize();
      if (!isFinite(side.x)) side.set(0, 0, 0);
      side.multiplyScalar(this.width * (0.25 + 0.75 * fresh) / 2);
      const shown = known(path[i]) ? point : new THREE.Vector3();
      this.position.setXYZ(2 * i, shown.x + side.x, shown.y + side.y, shown.z + side.z);
      this.position.setXYZ(2 * i + 1, shown.x - side.x, shown.y - side.y, shown.z - side.z);
      for (const v of [2 * i, 2 * i + 1]) this.rgba.setXYZW(v, this.colour.r, this.colour.g, this.colour.b, 0.9 * fresh);
      if (i > 0 && known(path[i]) && known(path[i - 1])) {
        const a = 2 * i - 2;
        [a, a + 1, a + 2, a + 1, a + 3, a + 2].forEach((v) => this.index.setX(corners++, v));
      }
    });
    this.mesh.geometry.setDrawRange(0, corners);
    for (const changed of [this.position, this.rgba, this.index]) changed.needsUpdate = true;
  }
}

// The camera as near as it can be with every point of the motion in the picture, seen from a direction in W; headroom
// [px] for a title.
function fitCamera(viewer, stage, view, headroom, from = CAMERA_FROM) {
  const toward = new THREE.Vector3(...from).normalize(), across = new THREE.Vector3(0, 0, 1).cross(toward).normalize();
  const axes = [across, toward.clone().cross(across), toward];            // right, up, toward the camera, in W
  const points = view.map((point) => axes.map((axis) => axis.dot(new THREE.Vector3(...point))));
  const tall = 0.96 * Math.tan(THREE.MathUtils.degToRad(viewer.camera.fov / 2));
  const wide = tall * stage.clientWidth / stage.clientHeight;
  const tallUp = tall * (1 - Math.min(headroom / stage.clientHeight, 0.5));
  // A point (x, y, z) shows when |x - x0| <= wide (d - z), and so on: the camera stands at (x0, y0, d).
  const most = (f) => Math.max(...points.map(f)), least = (f) => Math.min(...points.map(f));
  const right = most(([x, , z]) => x + wide * z), left = least(([x, , z]) => x - wide * z);
  const top = most(([, y, z]) => y + tallUp * z), bottom = least(([, y, z]) => y - tall * z);
  const d = Math.max((right - left) / (2 * wide), (top - bottom) / (tall + tallUp));
  const x0 = (right + left) / 2, y0 = (top - tallUp * d + bottom + tall * d) / 2;
  const eye = new THREE.Vector3(), target = new THREE.Vector3();
  [x0, y0, d].forEach((along, i) => eye.addScaledVector(axes[i], along));
  [x0, y0, 0].forEach((along, i) => target.addScaledVector(axes[i], along));
  viewer.scene.updateMatrixWorld(true);
  viewer.camera.position.copy(viewer.scene.localToWorld(eye));
  viewer.controls.target.copy(viewer.scene.localToWorld(target));
  viewer.controls.update();
  viewer.set_dirty();
}
