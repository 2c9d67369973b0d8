// Viewer of torchrg.render.page, based on deck.gl.
"use strict";

const $ = (id) => document.getElementById(id);
const showMessage = (text) => { $("message").textContent = text; $("message").hidden = !text; };
const TYPES = { 1: Uint8Array, 2: Uint16Array, 4: Uint32Array };
const HIDDEN = 128; // Bit of a point's mask: its plane is hidden.
const FIELD_OF_VIEW = 50; // Vertical, in degrees, as in deck.gl's view.
const MAX_NORMALS = 15000; // More lines obscure the surface.
const MAX_ROWS = 300; // Rows of the plane table.
const SLOW_MS = 45, FAST_MS = 22; // Frame times between which the number of points stays the same.
// Depth of the rim of a disc behind its center, in radii: where discs extend beyond an edge from both
// sides, the one with the nearer center is in front. Larger values make thin plates transparent.
const DOME = "1.0";
// Radius of a disc, in spacings; smaller ones leave gaps between random points.
const RADIUS = 1.75;
const STILL_MS = 250; // Time without motion after which all points are drawn again.

// ---- Data ------------------------------------------------------------------------------------

async function bytesOf(id) {
  const text = atob($(id).textContent);
  const packed = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) packed[i] = text.charCodeAt(i);
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  $(id).remove();
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

function unpack(manifest, bytes) {
  const arrays = {};
  let start = 0;
  for (const { name, width, rows, columns, differences } of manifest) {
    const values = new TYPES[width](rows * columns);
    for (let column = 0; column < columns; column++) {
      for (let byte = 0; byte < width; byte++, start += rows)
        for (let i = 0; i < rows; i++)
          values[i * columns + column] |= bytes[start + i] << (8 * byte);
      if (differences)
        for (let i = 1; i < rows; i++)
          values[i * columns + column] += values[(i - 1) * columns + column];
    }
    arrays[name] = values;
  }
  return arrays;
}

function directionsOf(places) {
  const directions = new Float32Array((places.length / 2) * 3);
  for (let i = 0; i < places.length / 2; i++) {
    if (places[2 * i] === 255) continue; // A point without a normal.
    let x = places[2 * i] / 127 - 1, y = places[2 * i + 1] / 127 - 1;
    const z = 1 - Math.abs(x) - Math.abs(y), fold = Math.max(-z, 0);
    x -= x < 0 ? -fold : fold;
    y -= y < 0 ? -fold : fold;
    directions.set(scaled([x, y, z], 1 / Math.hypot(x, y, z)), 3 * i);
  }
  return directions;
}

function preparePoints(cloud, bytes) {
  const arrays = unpack(cloud.arrays, bytes);
  const n = cloud.shown;
  cloud.values = arrays;
  cloud.positions = new Float32Array(3 * n);
  for (let i = 0; i < 3 * n; i++) cloud.positions[i] = arrays.positions[i] * cloud.step + cloud.low[i % 3];
  cloud.normals = arrays.normals ? directionsOf(arrays.normals) : new Float32Array(3 * n);
  cloud.colors = new Uint8Array(4 * n).fill(255);
  cloud.mask = arrays.covered.slice();
  cloud.hidden = new Set();
  cloud.changes = 0; // Number of changes to the set of hidden planes.
  cloud.lines = {}; // Cached polygons and normals.
  cloud.order = cloud.planes.map((_, i) => i).sort((a, b) => cloud.planes[b].count - cloud.planes[a].count);
  cloud.high = [0, 1, 2].map((axis) => {
    let high = -Infinity;
    for (let i = axis; i < 3 * n; i += 3) high = Math.max(high, cloud.positions[i]);
    return high;
  });
  delete arrays.positions;
  delete arrays.covered;
}

const planeOf = (cloud, i) => {
  const number = cloud.values.plane ? cloud.values.plane[i] : -1;
  return number < cloud.planes.length ? number : -1;
};

// ---- Vectors ---------------------------------------------------------------------------------

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const scaled = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const plus = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => scaled(a, 1 / (Math.hypot(...a) || 1));
const RADIANS = Math.PI / 180;

// ---- State -----------------------------------------------------------------------------------

const page = JSON.parse($("description").textContent);
const state = {
  mode: page.mode, cut: page.cut, outlines: false, normals: false, loose: true,
  top: 0, near: 0, size: 0, picked: null, fraction: 1, moving: false,
  sort: { by: "points", down: true }, minArea: 0,
  camera: { target: [0, 0, 0], rotationOrbit: 0, rotationX: 30, zoom: 5 },
};
let drawing = null, CloudLayer = null; // deck.gl's Deck, and the point layer.
const frames = []; // Times of the last frames, in milliseconds.

function axesOfView() {
  const { rotationX, rotationOrbit } = state.camera;
  const [a, b] = [rotationOrbit * RADIANS, rotationX * RADIANS];
  const toward = [-Math.sin(a) * Math.cos(b), -Math.cos(a) * Math.cos(b), Math.sin(b)];
  const right = [Math.cos(a), -Math.sin(a), 0];
  return { toward, right, up: cross(toward, right) };
}

function lookFrom(toward) {
  state.camera.rotationX = Math.asin(Math.max(-1, Math.min(1, toward[2]))) / RADIANS;
  if (Math.hypot(toward[0], toward[1]) > 1e-6)
    state.camera.rotationOrbit = Math.atan2(-toward[0], -toward[1]) / RADIANS;
}

function sizeOfView() {
  const { clientWidth, clientHeight } = $("view");
  return [clientWidth / page.clouds.length, clientHeight];
}

const focalLength = () => sizeOfView()[1] / 2 / Math.tan((FIELD_OF_VIEW / 2) * RADIANS);

// Fit the camera to the visible points, without outliers.
function showWhole() {
  const { right, up, toward } = axesOfView();
  const reach = [right, up, toward].map((axis) => {
    const places = [];
    for (const cloud of page.clouds) {
      const isCut = cutOf(cloud);
      const step = Math.max(1, Math.floor(cloud.shown / 20000));
      for (let i = 0; i < cloud.shown; i += step) if (!isCut(i)) places.push(dot(at(cloud.positions, i), axis));
    }
    places.sort((a, b) => a - b);
    const [low, high] = [0.002, 0.998].map((fraction) => places[Math.floor(fraction * (places.length - 1))] ?? 0);
    return [(low + high) / 2, Math.max(high - low, 1e-3)];
  });
  state.camera.target = [0, 1, 2].map((i) =>
    right[i] * reach[0][0] + up[i] * reach[1][0] + toward[i] * reach[2][0]);
  const [width, height] = sizeOfView();
  const pixels = 0.9 * Math.min(width / reach[0][1], height / reach[1][1]);
  // The foreground looks larger: step back by half of the depth.
  const distance = focalLength() / pixels;
  state.camera.zoom = Math.log2(pixels * distance / (distance + reach[2][1] * 0.35));
}

const at = (array, i) => [array[3 * i], array[3 * i + 1], array[3 * i + 2]];

// ---- Layers ----------------------------------------------------------------------------------

// The same tests as in the shader: hidden bits and clipping planes.
function limits(cloud) {
  const { toward } = axesOfView();
  const ahead = unit([toward[0], toward[1], 0]);
  const bits = HIDDEN | (state.cut ? cloud.surfaces.reduce((sum, direction, place) =>
    sum | (dot(direction, toward) > page.minFacing ? 1 << place : 0), 0) : 0);
  const first = page.clouds[0];
  const range = (axis) => {
    const ends = axis.map((a, i) => [a * first.low[i], a * first.high[i]]);
    const low = ends.reduce((sum, pair) => sum + Math.min(...pair), 0);
    return [low, ends.reduce((sum, pair) => sum + Math.max(...pair), 0)];
  };
  const limit = (percent, [low, high]) => (percent ? high - (percent / 100) * (high - low) : 1e9);
  return { bits, ahead, top: limit(state.top, range([0, 0, 1])), near: limit(state.near, range(ahead)) };
}

function cutOf(cloud) {
  const { bits, ahead, top, near } = limits(cloud);
  return (i) => (cloud.mask[i] & bits) !== 0 || cloud.positions[3 * i + 2] > top
    || dot(at(cloud.positions, i), ahead) > near;
}

function paint(cloud) {
  const channel = cloud.channels[state.mode];
  const values = channel && cloud.values[state.mode];
  const table = channel && !channel.direct ? cloud.values[`${state.mode} colors`] : null;
  const own = page.clouds[state.picked?.cloud] === cloud ? state.picked.plane : -1;
  const colors = cloud.colors = new Uint8Array(cloud.colors); // deck.gl compares by identity.
  for (let i = 0; i < cloud.shown; i++) {
    const dim = own >= 0 && planeOf(cloud, i) !== own ? 0.65 : 0;
    const from = table ? 3 * values[i] : 3 * i;
    const source = table ?? values;
    for (let c = 0; c < 3; c++) {
      const value = source ? source[from + c] : 170;
      colors[4 * i + c] = value + dim * (236 - value);
    }
  }
}

function hide(cloud) {
  cloud.changes += 1;
  const mask = cloud.mask = new Uint8Array(cloud.mask);
  for (let i = 0; i < cloud.shown; i++) {
    const plane = planeOf(cloud, i);
    const gone = plane < 0 ? !state.loose : cloud.hidden.has(plane);
    mask[i] = gone ? mask[i] | HIDDEN : mask[i] & ~HIDDEN;
  }
}

// A deck.gl layer with one vertex per point; the built-in layer draws an instanced triangle for each.
function makeCloudLayer({ Layer, picking, project32 }, { Model }) {
  const names = ["eye", "ahead", "light", "size", "limits"];
  const block = `layout(std140) uniform cutUniforms {
    ${names.map((name) => `vec4 ${name};`).join("\n    ")}
  } cut;`;
  // eye: position of the viewer; ahead: horizontal direction to the viewer, and its clipping distance;
  // light: toward the light; size: radius in space, focal length, minimum and maximum radius in pixels;
  // limits: hidden bits, and clipping height.
  const module = {
    name: "cut", vs: block,
    uniformTypes: Object.fromEntries(names.map((name) => [name, "vec4<f32>"])),
  };
  const vs = `#version 300 es
    in vec3 places;
    in vec3 normals;
    in vec4 colors;
    in float covers;
    in float radii;
    out vec4 vColor;
    out vec3 vDepth;
    void main(void) {
      geometry.worldPosition = places;
      int number = gl_VertexID + 1; // deck.gl's picking index: 0 is nothing.
      geometry.pickingColor = vec3(number & 255, number >> 8 & 255, number >> 16 & 255);
      gl_Position = project_position_to_clipspace(places, vec3(0.0), vec3(0.0), geometry.position);
      bool gone = (int(covers * 255.0 + 0.5) & int(cut.limits.x)) != 0;
      gone = gone || places.z > cut.limits.y || dot(places, cut.ahead.xyz) > cut.ahead.w;
      if (gone) gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
      vec3 sight = cut.eye.xyz - places;
      float space = cut.size.x * exp2((radii * 255.0 - 128.0) / 16.0);
      float radius = clamp(space * cut.size.y / length(sight), cut.size.z, cut.size.w);
      gl_PointSize = 2.0 * radius * project.devicePixelRatio;
      // Screen depth is linear in the inverse distance: its value at infinity, and the difference here.
      mat4 rows = transpose(project.viewProjectionMatrix);
      float farthest = dot(rows[2].xyz, rows[3].xyz) / dot(rows[3].xyz, rows[3].xyz);
      vDepth = vec3(farthest, gl_Position.z / gl_Position.w - farthest, radius / cut.size.y);
      float facing = dot(normals, sight) < 0.0 ? -1.0 : 1.0;
      float lit = dot(normals, normals) < 0.25 ? 0.6 : 0.5 + 0.5 * facing * dot(normals, cut.light.xyz);
      vColor = vec4(colors.rgb * (0.62 + 0.38 * lit), 1.0);
      DECKGL_FILTER_COLOR(vColor, geometry);
    }`;
  const fs = `#version 300 es
    precision highp float;
    in vec4 vColor;
    in vec3 vDepth;
    out vec4 fragColor;
    void main(void) {
      vec2 offset = 2.0 * gl_PointCoord - 1.0;
      float sqDistance = dot(offset, offset);
      if (sqDistance > 1.0) discard;
      gl_FragDepth = 0.5 + 0.5 * (vDepth.x + vDepth.y * (1.0 - ${DOME} * sqDistance * vDepth.z));
      fragColor = vColor;
      DECKGL_FILTER_COLOR(fragColor, geometry);
    }`;
  class CloudLayer extends Layer {
    initializeState() {
      const attributes = this.getAttributeManager();
      attributes.remove(["instancePickingColors"]);
      attributes.add({
        places: { size: 3, accessor: "getPosition" },
        normals: { size: 3, accessor: "getNormal" },
        colors: { size: 4, type: "unorm8", accessor: "getColor" },
        covers: { size: 1, type: "unorm8", accessor: "getCovers" },
        radii: { size: 1, type: "unorm8", accessor: "getRadius" },
      });
      const model = new Model(this.context.device, {
        ...this.getShaders(), id: this.props.id, topology: "point-list", isInstanced: false,
        bufferLayout: attributes.getBufferLayouts(),
      });
      this.setState({ model });
    }
    getShaders() { return super.getShaders({ vs, fs, modules: [project32, picking, module] }); }
    draw() {
      const { model } = this.state;
      model.setVertexCount(this.props.data.length);
      model.shaderInputs.setProps({ cut: this.props.cut });
      model.draw(this.context.renderPass);
    }
  }
  CloudLayer.layerName = "CloudLayer";
  const accessors = ["getPosition", "getNormal", "getColor", "getCovers", "getRadius"];
  CloudLayer.defaultProps = Object.fromEntries(
    accessors.map((name) => [name, { type: "accessor", value: [0, 0, 0, 0] }]));
  return CloudLayer;
}

function layersOf({ PathLayer, LineLayer }) {
  return page.clouds.flatMap((cloud, c) => {
    const { bits, ahead, top, near } = limits(cloud);
    const { toward, right, up } = axesOfView();
    const light = unit(plus(plus(scaled(right, -0.45), scaled(up, 0.7)), scaled(toward, 0.55)));
    const level = Math.max(1, Math.round(state.fraction * cloud.levels.length));
    const length = cloud.levels[level - 1] ?? 0;
    // Fewer points are larger, but leave gaps: without a GPU, the time goes to pixels.
    const growth = (cloud.shown / Math.max(length, 1)) ** 0.25;
    const radius = RADIUS * cloud.spacing * 1.15 ** state.size * growth;
    const eye = plus(state.camera.target, scaled(toward, focalLength() / 2 ** state.camera.zoom));
    const isCut = cutOf(cloud);
    const inView = ({ sides, rings }, plane) => !cloud.hidden.has(plane) && !(sides & bits)
      && rings[0].every((p) => p[2] <= top && dot(p, ahead) <= near);
    // Hidden planes have no polygon; cut-away planes have one, which shows their position.
    const picked = state.picked?.cloud === c && !cloud.hidden.has(state.picked.plane) ? state.picked.plane : -1;
    const rings = (chosen) => cloud.planes.flatMap((plane, number) =>
      chosen(plane, number) ? plane.rings.map((ring) => ({ ring: [...ring, ring[0]] })) : []);
    // deck.gl rebuilds lines if their data is a new object, so reuse it unless it may differ.
    const cuts = [cloud.changes, bits, top, near === 1e9 ? 0 : [near, ...ahead]].join();
    const side = Math.round(state.camera.rotationOrbit / 45);
    const outlines = () => cached(cloud, "outlines", cuts, () => rings(inView));
    const ofPicked = () => cached(cloud, "picked", picked, () => rings((_, n) => n === picked));
    const normals = () => cached(cloud, "normals", `${cuts} ${side}`, () => normalLines(cloud, isCut));
    const lines = (id, data, color, width) => new PathLayer({
      id: `${id}-${c}`, data, getPath: (row) => row.ring, getColor: color, getWidth: width,
      widthUnits: "pixels", jointRounded: true, capRounded: true,
      ...(id === "outlines" ? { getPolygonOffset: () => [0, -4000] } : { parameters: { depthCompare: "always" } }),
    });
    return [
      new CloudLayer({
        id: `points-${c}`, pickable: true,
        data: {
          length,
          attributes: {
            getPosition: { value: cloud.positions, size: 3 },
            getNormal: { value: cloud.normals, size: 3 },
            getColor: { value: cloud.colors, size: 4, normalized: true },
            getCovers: { value: cloud.mask, size: 1, normalized: true },
            getRadius: { value: cloud.values.radii, size: 1, normalized: true },
          },
        },
        cut: {
          eye: [...eye, 0], ahead: [...ahead, near], light: [...light, 0],
          size: [radius, focalLength(), 0.8, 30], limits: [bits, top, 0, 0],
        },
      }),
      state.outlines && lines("outlines", outlines(), [20, 28, 40, 210], 1.5),
      picked >= 0 && lines("halo", ofPicked(), [255, 255, 255], 6),
      picked >= 0 && lines("picked", ofPicked(), [0, 0, 0], 2.5),
      state.normals && new LineLayer({
        id: `normals-${c}`, data: normals(), getColor: [11, 60, 160, 200], getWidth: 1,
        getSourcePosition: (row) => row[0], getTargetPosition: (row) => row[1],
      }),
    ];
  });
}

function cached(cloud, name, key, make) {
  if (cloud.lines[name]?.key !== key) cloud.lines[name] = { key, data: make() };
  return cloud.lines[name].data;
}

function normalLines(cloud, isCut) {
  const { toward } = axesOfView();
  const lines = [], step = Math.max(1, Math.floor(cloud.shown / MAX_NORMALS));
  const length = Math.min(0.25, Math.max(0.05, 4 * cloud.spacing));
  for (let i = 0; i < cloud.shown; i += step) {
    const [foot, normal] = [at(cloud.positions, i), at(cloud.normals, i)];
    if (isCut(i) || !(normal[0] || normal[1] || normal[2])) continue;
    lines.push([foot, plus(foot, scaled(normal, dot(normal, toward) < 0 ? -length : length))]);
  }
  return lines;
}

function draw() {
  drawing.setProps({ layers: layersOf(globalThis.deck), viewState: { ...state.camera } });
  showScale();
}

// ---- Camera motion ---------------------------------------------------------------------------

let stillTimer = 0, lastFrame = 0;
function moved() {
  clearTimeout(stillTimer);
  if (!state.moving) { state.moving = true; lastFrame = 0; }
  stillTimer = setTimeout(() => {
    state.moving = false;
    if (state.fraction < 1) { state.lastFraction = state.fraction; state.fraction = 1; draw(); }
  }, STILL_MS);
  if (state.fraction === 1 && state.lastFraction) { state.fraction = state.lastFraction; state.lastFraction = 0; }
  draw();
}

// Slow machines draw fewer strata during motion, to reach about 30 frames per second.
function afterFrame() {
  const now = performance.now();
  if (lastFrame && state.moving) {
    const time = now - lastFrame;
    frames.push(time);
    if (frames.length > 120) frames.shift();
    if (time > SLOW_MS) state.fraction = Math.max(0.125, state.fraction * Math.max(0.3, FAST_MS / time));
    else if (time < FAST_MS) state.fraction = Math.min(1, state.fraction * 1.2);
  }
  lastFrame = now;
}

function turn(dx, dy) {
  state.camera.rotationOrbit += dx;
  state.camera.rotationX = Math.max(-90, Math.min(90, state.camera.rotationX + dy));
  moved();
}

function shift(dx, dy) {
  const { right, up } = axesOfView();
  const step = 60 / 2 ** state.camera.zoom;
  state.camera.target = plus(state.camera.target, plus(scaled(right, dx * step), scaled(up, dy * step)));
  moved();
}

function zoom(by) { state.camera.zoom += by; moved(); }

function home(toward) {
  if (toward) lookFrom(toward);
  showWhole();
  moved();
}

function showScale() {
  const perUnit = 2 ** state.camera.zoom / page.frame.scale; // Pixels per unit of the cloud.
  const power = 10 ** Math.floor(Math.log10(160 / perUnit));
  const length = [5, 2, 1].find((digit) => digit * power * perUnit <= 160) * power;
  $("scale").hidden = false;
  $("scale").firstChild.textContent = `${number(length)} ${page.unit}`;
  $("scale").lastChild.style.width = `${length * perUnit}px`;
}

// ---- Picking ---------------------------------------------------------------------------------

const number = (value, digits = 4) => (value !== 0 && Math.abs(value) < 1e-4 ? value.toExponential(1)
  : Number(value.toPrecision(digits)).toLocaleString("en", { maximumSignificantDigits: digits }));
// Coordinates to a ten-thousandth of the cloud or better.
const decimals = Math.max(0, 4 - Math.floor(Math.log10(page.frame.scale * 10)));
const place = (value) => (Math.round(value * 10 ** decimals) / 10 ** decimals + 0)
  .toLocaleString("en", { minimumFractionDigits: decimals, maximumFractionDigits: decimals });
const inFile = (point) => {
  const { origin, rotation, scale } = page.frame;
  return [0, 1, 2].map((axis) =>
    origin[axis] + scale * (rotation[0][axis] * point[0] + rotation[1][axis] * point[1] + rotation[2][axis] * point[2]));
};
const inFileDirection = (v) => [0, 1, 2].map((axis) =>
  page.frame.rotation[0][axis] * v[0] + page.frame.rotation[1][axis] * v[1] + page.frame.rotation[2][axis] * v[2]);

function pick(x, y) {
  drawing.setProps({ _pickable: true });
  const found = drawing.pickObject({ x, y, radius: 5 });
  drawing.setProps({ _pickable: false });
  const c = found ? Number(found.layer.id.split("-")[1]) : -1;
  choose(found && found.layer.id.startsWith("points") ? { cloud: c, point: found.index,
    plane: planeOf(page.clouds[c], found.index) } : null);
  return state.picked;
}

function choose(picked) {
  const before = state.picked;
  state.picked = picked;
  for (const c of new Set([before?.cloud, picked?.cloud])) if (c !== undefined) paint(page.clouds[c]);
  if (picked && picked.cloud !== Number($("cloud").value)) { $("cloud").value = picked.cloud; listPlanes(); }
  describePicked();
  markRow();
  draw();
}

function step(by) {
  const c = state.picked?.cloud ?? Number($("cloud").value);
  const { order } = page.clouds[c];
  if (!order.length) return;
  const place = state.picked?.plane >= 0 ? order.indexOf(state.picked.plane) + by : by > 0 ? 0 : order.length - 1;
  choose({ cloud: c, plane: order[(place + order.length) % order.length] });
}

function element(tag, text, properties = {}) {
  const made = Object.assign(document.createElement(tag), properties);
  if (text !== null) made.textContent = text;
  return made;
}

// Columns with a special representation; the remaining ones are listed by name.
const SPECIAL = ["name", "kind", "curved", "normal", "offset", "area", "extent", "rms", "count", "rings", "meets", "sides"];

function describePicked() {
  const box = $("picked");
  box.replaceChildren();
  if (!state.picked) {
    box.append(element("p", "Click a point, or select a plane below.", { className: "soft" }));
    return;
  }
  const { cloud: c, plane: own, point } = state.picked;
  const cloud = page.clouds[c], list = element("dl", null);
  const add = (name, ...content) => {
    const cell = element("dd", null);
    cell.append(...content);
    list.append(element("dt", name), cell);
  };
  if (page.clouds.length > 1) add("in", cloud.name);
  if (own >= 0) {
    const plane = cloud.planes[own];
    add("plane", `${plane.name}${plane.curved ? " (curved)" : ""}, ${page.kinds[plane.kind]}`);
    add("equation", equation(plane));
    add("area", `${number(plane.area)} ${page.unit}²`);
    add("extent", `${plane.extent.map((side) => number(side)).join(" × ")} ${page.unit}`);
    add("rms", page.unit === "m" ? `${(1000 * plane.rms).toFixed(1)} mm` : `${number(plane.rms, 3)} ${page.unit}`);
    add("points", plane.count.toLocaleString("en"));
    for (const [name, value] of Object.entries(plane)) {
      if (SPECIAL.includes(name) || value === null) continue; // A level plane has no dip direction.
      const text = typeof value === "number" ? number(value) : `${value}`;
      add(name.replace(/_deg$/, "").replaceAll("_", " "), name.endsWith("_deg") ? `${text}°` : text);
    }
    const met = plane.meets.slice().sort((first, second) => second[2] - first[2]).slice(0, 12).map(([other, angle]) =>
      element("button", `${cloud.planes[other].name}: ${angle}°`, {
        title: `plane ${cloud.planes[other].name}, at ${angle} degrees`,
        onclick: () => choose({ cloud: c, plane: other }) }));
    if (met.length) add("adjacent", ...met);
  } else add("plane", "unlabeled");
  if (point !== undefined) {
    add("position", inFile(at(cloud.positions, point)).map(place).join("  "));
    const normal = at(cloud.normals, point);
    if (dot(normal, normal) > 0) add("normal", inFileDirection(normal).map((v) => v.toFixed(2)).join("  "));
    if (cloud.values.curvature) add("curvature", number(0.1 * (cloud.values.curvature[point] / 255) ** 2, 2));
    if (cloud.values.sharp) add("sharp", cloud.values.sharp[point] ? "yes" : "no");
    if (cloud.values.superpoint) add("superpoint", String(cloud.values.superpoint[point]));
    for (const mode of ["error", "normal-error"]) {
      const values = cloud.values[mode];
      if (values) add(mode === "error" ? "outcome" : "normal error", mode === "error"
        ? cloud.channels.error.legend[values[point]][1] : `${number((values[point] / 255) * 45, 2)}°`);
    }
  }
  box.append(list);
  if (own < 0) return;
  const row = element("div", null, { className: "row" });
  row.append(
    element("button", cloud.hidden.has(own) ? "Show" : "Hide", { onclick: () => setHidden(c, [own], !cloud.hidden.has(own)) }),
    element("button", "Show only this", { onclick: () => only(c, own) }),
    element("button", "Zoom to it", { onclick: () => lookAt(c, own) }));
  box.append(row);
}

function equation({ normal, offset }) {
  const terms = ["x", "y", "z"].map((axis, i) => [normal[i], `${Math.abs(normal[i]).toFixed(4)} ${axis}`])
    .filter(([value]) => Math.abs(value) >= 0.00005);
  const left = terms.map(([value, text], i) => (value < 0 ? (i ? "− " : "−") : i ? "+ " : "") + text).join(" ");
  return `${left} = ${place(offset)}`;
}

function lookAt(c, own) {
  const ring = page.clouds[c].planes[own].rings[0];
  const middle = scaled(ring.reduce(plus, [0, 0, 0]), 1 / ring.length);
  const reach = Math.max(...ring.map((p) => Math.hypot(...plus(p, scaled(middle, -1)))), 0.05);
  state.camera.target = middle;
  state.camera.zoom = Math.log2(Math.min(...sizeOfView()) / reach / 4);
  moved();
}

function setHidden(c, planes, hidden) {
  const cloud = page.clouds[c];
  for (const plane of planes) cloud.hidden[hidden ? "add" : "delete"](plane);
  hide(cloud);
  listPlanes();
  describePicked();
  draw();
}

function only(c, own) {
  const cloud = page.clouds[c];
  const others = cloud.order.filter((plane) => plane !== own);
  setHidden(c, cloud.order, false);
  setHidden(c, others, true);
}

// ---- Panel -----------------------------------------------------------------------------------

function chip(color) {
  const made = element("i", null, { className: "chip" });
  made.style.background = `rgb(${color.join(",")})`;
  return made;
}

function showLegend() {
  const entries = page.clouds.map((cloud) => cloud.channels[state.mode]?.legend ?? []).find((list) => list.length) ?? [];
  $("legend").replaceChildren(...entries.map(([color, meaning]) => {
    const entry = element("span", null);
    entry.append(chip(color), meaning);
    return entry;
  }));
}

function listKinds(c, cloud) {
  const ofKind = (kind) => cloud.order.filter((own) => cloud.planes[own].kind === kind);
  const present = page.kinds.map((name, kind) => [name, ofKind(kind)]).filter(([, planes]) => planes.length);
  $("kinds").replaceChildren(...present.map(([name, planes]) => {
    const label = element("label", null), numHidden = planes.filter((own) => cloud.hidden.has(own)).length;
    const box = element("input", null, { type: "checkbox", checked: numHidden < planes.length,
      indeterminate: numHidden > 0 && numHidden < planes.length,
      onchange: (event) => setHidden(c, planes, !event.target.checked) });
    box.setAttribute("aria-label", `show ${name} planes`);
    label.append(box, ` ${name} (${planes.length})`);
    return label;
  }));
}

// Sort keys of the columns of the plane table.
const COLUMNS = {
  plane: (plane) => Number(plane.name), class: (plane) => page.kinds[plane.kind],
  area: (plane) => plane.area, points: (plane) => plane.count,
};

function sortBy(name) {
  state.sort = { by: name, down: state.sort.by === name ? !state.sort.down : ["area", "points"].includes(name) };
  listPlanes();
}

function sortedPlanes(cloud) {
  const key = (own) => COLUMNS[state.sort.by](cloud.planes[own]), sign = state.sort.down ? -1 : 1;
  return cloud.order.filter((own) => cloud.planes[own].area >= state.minArea)
    .sort((a, b) => sign * (key(a) < key(b) ? -1 : key(a) > key(b) ? 1 : 0));
}

function limitArea(area) {
  state.minArea = area;
  page.clouds.forEach((cloud, c) => {
    const isSmall = (own) => cloud.planes[own].area < area;
    setHidden(c, cloud.order.filter((own) => !isSmall(own)), false);
    setHidden(c, cloud.order.filter(isSmall), true);
  });
}

// The header and the rows of visible planes of a CSV table.
function shownTable(cloud) {
  const lines = new TextDecoder().decode(cloud.values.table).split(/(?<=\n)/);
  return lines.filter((_, i) => i === 0 || !cloud.hidden.has(i - 1)).join("");
}

function listPlanes() {
  const c = Number($("cloud").value), cloud = page.clouds[c];
  const focused = document.activeElement?.getAttribute?.("aria-label");
  listKinds(c, cloud);
  $("csv").hidden = !cloud.values.table;
  if (!cloud.order.length) {
    $("planes").replaceChildren(element("p", "This file has no plane labels.", { className: "soft" }));
    return;
  }
  const table = element("table", null), head = element("tr", null), listed = sortedPlanes(cloud);
  head.append(...Object.keys(COLUMNS).map((name) => {
    const cell = element("th", null, { scope: "col" }), isSorted = state.sort.by === name;
    const title = name === "area" ? `area (${page.unit}²)` : name, arrow = state.sort.down ? " ↓" : " ↑";
    cell.append(element("button", title + (isSorted ? arrow : ""), { onclick: () => sortBy(name) }));
    if (isSorted) cell.setAttribute("aria-sort", state.sort.down ? "descending" : "ascending");
    return cell;
  }), element("th", "shown", { scope: "col" }));
  table.append(head, ...listed.slice(0, MAX_ROWS).map((own) => {
    const plane = cloud.planes[own], row = element("tr", null);
    row.dataset.plane = own;
    const colors = cloud.values["plane colors"];
    const name = element("button", plane.name, { onclick: () => choose({ cloud: c, plane: own }) });
    name.prepend(chip([...colors.slice(3 * own, 3 * own + 3)]));
    const box = element("input", null, { type: "checkbox", checked: !cloud.hidden.has(own),
      onchange: (event) => setHidden(c, [own], !event.target.checked) });
    box.setAttribute("aria-label", `show plane ${plane.name}`);
    const cells = [name, page.kinds[plane.kind], number(plane.area, 3), plane.count.toLocaleString("en"), box];
    row.append(...cells.map((content) => { const cell = element("td", null); cell.append(content); return cell; }));
    return row;
  }));
  $("planes").replaceChildren(table);
  if (listed.length > MAX_ROWS)
    $("planes").append(element("p", `The first ${MAX_ROWS} of ${listed.length.toLocaleString("en")}.`, { className: "soft" }));
  if (focused?.startsWith("show ")) document.querySelector(`[aria-label="${CSS.escape(focused)}"]`)?.focus();
  markRow();
}

function markRow() {
  const c = Number($("cloud").value);
  for (const row of $("planes").querySelectorAll("tr")) {
    const marked = state.picked?.cloud === c && Number(row.dataset.plane) === state.picked.plane;
    row.setAttribute("aria-selected", marked);
    if (!marked) continue;
    const [box, above] = [$("planes"), row.offsetTop - $("planes").offsetTop];
    if (above < box.scrollTop || above > box.scrollTop + box.clientHeight - 24) box.scrollTop = above - 60;
  }
}

function setMode(mode) {
  state.mode = mode;
  $("mode").value = mode;
  page.clouds.forEach(paint);
  showLegend();
  draw();
}

function fillPanel() {
  for (const [mode, name] of page.modes) $("mode").append(element("option", name, { value: mode }));
  $("mode").disabled = !page.modes.length;
  if (!page.modes.length) $("mode").append(element("option", "none: the file has only points"));
  $("mode").value = page.mode;
  $("mode").onchange = (event) => setMode(event.target.value);
  for (const name of ["cut", "outlines", "normals", "loose"]) {
    $(name).checked = state[name];
    $(name).onchange = (event) => {
      state[name] = event.target.checked;
      if (name === "loose") page.clouds.forEach(hide);
      draw();
    };
  }
  for (const name of ["top", "near", "size"])
    $(name).oninput = (event) => { state[name] = Number(event.target.value); moved(); };
  const only = (id, shown) => { $(id).disabled = !shown; $(id).parentElement.hidden = !shown; };
  only("cut", page.clouds.some((cloud) => cloud.surfaces.length));
  only("outlines", page.clouds.some((cloud) => cloud.planes.length));
  only("loose", page.clouds.some((cloud) => cloud.planes.length));
  only("normals", page.clouds.some((cloud) => cloud.values.normals));
  $("home").onclick = () => home(page.toward);
  $("above").onclick = () => home([0, 0, 1]);
  $("level").onclick = () => { state.camera.rotationX = 0; home(); };
  $("showall").onclick = () => { $("minarea").value = ""; limitArea(0); };
  $("minarea").oninput = (event) => limitArea(Number(event.target.value));
  $("csv").onclick = () => {
    const cloud = page.clouds[Number($("cloud").value)];
    const href = URL.createObjectURL(new Blob([shownTable(cloud)], { type: "text/csv" }));
    element("a", null, { href, download: `${cloud.name}_planes.csv` }).click();
    setTimeout(() => URL.revokeObjectURL(href), STILL_MS);
  };
  page.clouds.forEach((cloud, c) => {
    $("cloud").append(element("option", cloud.name, { value: c }));
    const title = element("div", cloud.name, { className: "name" });
    title.style.left = `calc(${(100 * c) / page.clouds.length}% + 12px)`;
    if (page.clouds.length > 1) document.querySelector("main").append(title);
    const lines = [`${cloud.count.toLocaleString("en")} points, ${cloud.planes.length.toLocaleString("en")} planes`];
    if (cloud.finite < cloud.count) lines.push(`${(cloud.count - cloud.finite).toLocaleString("en")} points are not finite and not shown`);
    if (cloud.shown < cloud.finite) lines.push(`showing a random sample of ${cloud.shown.toLocaleString("en")} points`);
    $("facts").append(...lines.map((line) => element("p", page.clouds.length > 1 ? `${cloud.name}: ${line}` : line)));
  });
  $("cloud").onchange = listPlanes;
  $("which").hidden = $("seam").hidden = page.clouds.length < 2;
  listPlanes();
  showLegend();
}

const KEYS = {
  ArrowLeft: (event) => (event.shiftKey ? shift(-1, 0) : turn(-5, 0)),
  ArrowRight: (event) => (event.shiftKey ? shift(1, 0) : turn(5, 0)),
  ArrowUp: (event) => (event.shiftKey ? shift(0, 1) : turn(0, 5)),
  ArrowDown: (event) => (event.shiftKey ? shift(0, -1) : turn(0, -5)),
  "+": () => zoom(0.25), "=": () => zoom(0.25), "-": () => zoom(-0.25),
  PageDown: () => step(1), PageUp: () => step(-1), Home: () => home(page.toward), Escape: () => choose(null),
  h: () => state.picked?.plane >= 0 && setHidden(state.picked.cloud, [state.picked.plane],
    !page.clouds[state.picked.cloud].hidden.has(state.picked.plane)),
  o: () => {
    const { cloud: c, plane } = state.picked ?? { plane: -1 };
    if (plane < 0) return;
    if (page.clouds[c].hidden.size) setHidden(c, page.clouds[c].order, false);
    else only(c, plane);
  },
  c: () => $("cut").click(),
  m: () => {
    const names = page.modes.map(([mode]) => mode);
    if (names.length) setMode(names[(names.indexOf(state.mode) + 1) % names.length]);
  },
};

function listen() {
  const box = $("view");
  let pressed = null;
  box.addEventListener("pointerdown", (event) => { pressed = event; box.focus({ focusVisible: false }); });
  box.addEventListener("pointerup", (event) => {
    const still = pressed && Math.hypot(event.clientX - pressed.clientX, event.clientY - pressed.clientY) < 4;
    if (still && event.button === 0) {
      const { left, top } = box.getBoundingClientRect();
      pick(event.clientX - left, event.clientY - top);
    }
    pressed = null;
  });
  box.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || !KEYS[event.key]) return;
    event.preventDefault();
    KEYS[event.key](event);
  });
  box.addEventListener("contextmenu", (event) => event.preventDefault());
}

// ---- Start -----------------------------------------------------------------------------------

async function begin() {
  if (!globalThis.DecompressionStream) throw new Error("This browser is too old to decompress the page.");
  const library = element("script", new TextDecoder().decode(await bytesOf("blob0")));
  for (const [c, cloud] of page.clouds.entries()) preparePoints(cloud, await bytesOf(`blob${c + 1}`));
  fillPanel();
  if (page.clouds.every((cloud) => !cloud.shown)) return showMessage("The cloud has no finite points.");
  if (!document.createElement("canvas").getContext("webgl2"))
    throw new Error("This browser does not support WebGL 2.");
  document.head.append(library); // Runs at once: the content security policy allows its hash.
  const { Deck, OrbitView } = globalThis.deck;
  CloudLayer = makeCloudLayer(globalThis.deck, globalThis.luma);
  page.clouds.forEach(paint);
  lookFrom(page.toward);
  showWhole();
  const percent = 100 / page.clouds.length;
  drawing = new Deck({
    parent: $("view"), width: "100%", height: "100%", useDevicePixels: true,
    views: page.clouds.map((_, c) => new OrbitView({
      id: String(c), x: `${c * percent}%`, width: `${percent}%`, orbitAxis: "Z", fovy: FIELD_OF_VIEW,
      controller: { keyboard: false, doubleClickZoom: false },
    })),
    layerFilter: ({ layer, viewport }) => layer.id.split("-")[1] === viewport.id,
    viewState: { ...state.camera },
    onViewStateChange: ({ viewState }) => {
      const { target, rotationX, rotationOrbit, zoom } = viewState;
      state.camera = { target, rotationX, rotationOrbit, zoom: Array.isArray(zoom) ? zoom[0] : zoom };
      moved();
    },
    onAfterRender: afterFrame,
    onError: fail,
    onLoad: () => { showMessage(""); page.ready = true; },
    _pickable: false, // Enabled on click: picking on hover costs a frame each time.
    layers: layersOf(globalThis.deck),
  });
  listen();
  showScale();
}

let failed = false;
function fail(error) { // The first error is the cause; later ones follow from it.
  if (!failed) showMessage(`This page cannot be displayed: ${error.message}`);
  failed = true;
  console.error(error.message);
}

globalThis.torchrg = { page, state, frames, pick, choose, setMode, setHidden, turn, home, draw, deck: () => drawing };
begin().catch(fail);
