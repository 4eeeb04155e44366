"use strict";
// The recording and both simulators as bodies in space, at the clock's time. Drawn on demand.
(() => {
  const source = document.getElementById("scene");
  const stage = document.getElementById("stage");
  if (!source || !stage || !clock) return;
  const told = JSON.parse(source.textContent);
  const note = document.getElementById("stage-note");
  const PARTS = ["recorded", "before", "after"];

  const { floats, geometry, place, below, grid, cell } = shapesOf(told);

  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ canvas: stage, antialias: true, alpha: true });
  } catch {
    note.textContent = "This browser offers no WebGL, which the replay needs; the plots show the same motion.";
    return;
  }
  const scene = new THREE.Scene();
  const camera = new THREE.PerspectiveCamera(35, 16 / 10, told.radius / 50, told.radius * 60);
  camera.up.set(0, 0, 1);
  const orbit = new THREE.OrbitControls(camera, stage);
  orbit.enablePan = false;
  orbit.enableZoom = false; // the wheel scrolls the page until the replay has the focus
  stage.addEventListener("focus", () => { orbit.enableZoom = true; });
  stage.addEventListener("blur", () => { orbit.enableZoom = false; });
  orbit.minDistance = told.radius * 0.4;
  orbit.maxDistance = told.radius * 15;
  const sky = new THREE.HemisphereLight(0xffffff, 0x8a8f96, 2.2);
  sky.position.set(0, 0, 1);
  const lamp = new THREE.DirectionalLight(0xffffff, 1.6);
  scene.add(sky, lamp);

  const plain = ({ colour }) => colour.every((value, i) => Math.abs(value - [0.5, 0.5, 0.5, 1][i]) < 1e-3);
  const forms = told.shapes.map(geometry);

  // Ghosts lie a little behind what was recorded, so that where they agree the recording is seen.
  const ghosts = {};
  const inks = []; // materials in the page's colours: those of shapes that the model gives none
  function material(part, shape) {
    if (part === "world" || part === "recorded") {
      const [r, g, b, a] = shape.colour;
      const side = shape.kind === "plane" || shape.vertices ? THREE.DoubleSide : 0;
      const own = shape.kind === "plane" ? { polygonOffset: true, polygonOffsetFactor: 2, polygonOffsetUnits: 2 } : {};
      const color = new THREE.Color().setRGB(r, g, b, "srgb");
      const made = new THREE.MeshLambertMaterial({ color, opacity: a, transparent: a < 1, side, ...own });
      if (plain(shape)) inks.push([made, part === "recorded" ? "--observed" : shape.kind === "plane" ? "--faint" : "--noise"]);
      return made;
    }
    ghosts[part] ??= new THREE.MeshLambertMaterial({
      transparent: true, opacity: 0.62, polygonOffset: true, polygonOffsetFactor: part === "before" ? 3 : 1.5,
      polygonOffsetUnits: 4,
    });
    return ghosts[part];
  }

  const actors = Object.fromEntries(PARTS.map((part) => {
    const bodies = Array.from({ length: told.bodies }, (_, i) => {
      const body = new THREE.Group();
      body.scale.setScalar(told.scales[i]);
      scene.add(body);
      return body;
    });
    return [part, bodies];
  }));
  told.shapes.forEach((shape, i) => {
    if (shape.body < 0) {
      scene.add(place(new THREE.Mesh(forms[i], material("world", shape)), shape));
      return;
    }
    PARTS.forEach((part) => {
      actors[part][shape.body].add(place(new THREE.Mesh(forms[i], material(part, shape)), shape));
    });
  });

  // Lines on planes, or on a floor where the model has none: something to see the motion against.
  const ink = new THREE.LineBasicMaterial();
  const planes = told.shapes.filter((shape) => shape.body < 0 && shape.kind === "plane");
  planes.filter((shape) => !shape.size[0] && !shape.size[1]).forEach((shape) => {
    scene.add(place(grid(...below(shape), ink), shape));
  });
  if (!planes.length) {
    const [x, y] = told.centre;
    const floor = grid(Math.round(x / cell) * cell, Math.round(y / cell) * cell, ink);
    floor.position.z = told.floor;
    scene.add(floor);
  }

  // Where in space the condition holds: the way of every body's largest shape, with beads where it does.
  const way = new THREE.Group();
  const beads = new THREE.MeshLambertMaterial();
  const bead = new THREE.SphereGeometry(0.012 * told.radius, 10, 8);
  scene.add(way);
  function trace(chosen) {
    way.clear();
    stage.dataset.beads = "0";
    if (!chosen?.way) return;
    const points = floats(chosen.way);
    const count = points.length / 3 / chosen.acts.length;
    for (let body = 0; body < count; body++) {
      const [line, at] = [[], (frame) => points.subarray(3 * (frame * count + body), 3 * (frame * count + body) + 3)];
      for (let frame = 0; frame < chosen.acts.length; frame++) {
        if (!Number.isFinite(at(frame)[0])) continue;
        if (frame && Number.isFinite(at(frame - 1)[0])) line.push(...at(frame - 1), ...at(frame));
        if (chosen.acts[frame] !== "1") continue;
        const ball = new THREE.Mesh(bead, beads);
        ball.position.set(...at(frame));
        way.add(ball);
      }
      const lines = new THREE.BufferGeometry();
      lines.setAttribute("position", new THREE.BufferAttribute(new Float32Array(line), 3));
      way.add(new THREE.LineSegments(lines, ink));
    }
    stage.dataset.beads = String(way.children.filter((one) => one.geometry === bead).length);
  }

  // Places that named effects have: a patch's edge, the point that a string or a pull goes to.
  const places = new THREE.MeshLambertMaterial({ transparent: true, opacity: 0.3, side: THREE.DoubleSide });
  told.marks.forEach(({ at, normal }) => {
    const size = normal ? 0.8 * told.radius : 0.03 * told.radius;
    const form = normal ? new THREE.PlaneGeometry(2 * size, 2 * size) : new THREE.SphereGeometry(size, 20, 14);
    const mark = new THREE.Mesh(form, normal ? places : beads);
    if (normal) mark.quaternion.setFromUnitVectors(new THREE.Vector3(0, 0, 1), new THREE.Vector3(...normal).normalize());
    mark.position.set(...at);
    scene.add(mark);
  });

  function paint() {
    const style = getComputedStyle(document.documentElement);
    const value = (name) => new THREE.Color(style.getPropertyValue(name).trim());
    Object.entries(ghosts).forEach(([part, own]) => own.color.copy(value(`--${part}`)));
    inks.forEach(([own, name]) => own.color.copy(value(name)));
    ink.color.copy(value("--line"));
    [beads, places].forEach((own) => own.color.copy(value("--span-edge")));
    request();
  }

  let shown = null; // the motion as it was told
  let byHand = false; // the reader chose how differences are drawn
  let motion = null;
  const poses = {};
  const from = new THREE.Quaternion();
  const to = new THREE.Quaternion();

  // Ghosts farther from the recording than they are, by as many times as the reader asks; to first order
  // the joints stay closed.
  const magnify = document.getElementById("magnify");
  const back = new THREE.Quaternion();
  function exaggerate(body, recorded) {
    const times = Number(magnify.value);
    body.position.sub(recorded.position).multiplyScalar(times).add(recorded.position);
    back.copy(recorded.quaternion).invert();
    to.copy(body.quaternion).multiply(back);
    if (to.w < 0) to.set(-to.x, -to.y, -to.z, -to.w);
    const half = Math.acos(Math.min(to.w, 1));
    const sine = Math.sin(half);
    if (sine < 1e-9) return;
    const turned = Math.min(half * times, Math.PI / 2);
    const share = Math.sin(turned) / sine;
    to.set(to.x * share, to.y * share, to.z * share, Math.cos(turned));
    body.quaternion.copy(recorded.quaternion).premultiply(to);
  }

  function pose(part, frame, share) {
    const values = poses[part];
    const wide = 7 * told.bodies;
    actors[part].forEach((body, i) => {
      const a = frame * wide + 7 * i;
      const b = Math.min(a + wide, values ? values.length - wide + 7 * i : a);
      const there = Boolean(values) && Number.isFinite(values[a]);
      body.visible = there && !page.hidden.has(part);
      if (!there) return;
      const next = Number.isFinite(values[b]) ? b : a;
      const mixed = (k) => values[a + k] + share * (values[next + k] - values[a + k]);
      body.position.set(mixed(0), mixed(1), mixed(2));
      from.set(values[a + 4], values[a + 5], values[a + 6], values[a + 3]);
      to.set(values[next + 4], values[next + 5], values[next + 6], values[next + 3]);
      body.quaternion.copy(from.slerp(to, share));
      const recorded = poses.recorded && Number.isFinite(poses.recorded[frame * wide + 7 * i]);
      if (part !== "recorded" && recorded && magnify.value !== "1") exaggerate(body, actors.recorded[i]);
    });
  }

  function at(time) {
    if (!motion) return;
    const times = motion.time;
    let low = 0;
    let high = times.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (times[middle] <= time) low = middle;
      else high = middle;
    }
    const width = times[high] - times[low];
    const share = width > 0 ? Math.min(Math.max((time - times[low]) / width, 0), 1) : 0;
    PARTS.forEach((part) => pose(part, low, share));
    request();
  }

  function choose(part) {
    const stem = part.dataset.stem;
    const chosen = Object.hasOwn(told.motions, stem) ? told.motions[stem] : null;
    shown = chosen;
    motion = chosen && { time: floats(chosen.time).map((t) => t + chosen.begin) };
    PARTS.forEach((one) => { poses[one] = chosen?.[one] ? floats(chosen[one]) : null; });
    trace(chosen);
    stage.hidden = !chosen;
    magnify.disabled = !chosen?.recorded;
    if (!byHand) magnify.value = String(chosen?.factor ?? 1);
    tell();
    at(clock.state.now);
  }

  function tell() {
    if (!shown) note.textContent = "This recording has no replay: it is kept for the six that are predicted worst.";
    else if (!shown.recorded) note.textContent = "Not all positions were recorded: the simulators alone.";
    else {
      const larger = magnify.value === "1" ? "" : `Differences are drawn ${magnify.value} times as large as they are.`;
      note.textContent = [shown.after ? "" : stage.dataset.alike, larger].filter(Boolean).join(" ");
    }
  }

  function home() {
    const away = told.radius / Math.sin((camera.fov * Math.PI) / 360) / Math.min(1, camera.aspect);
    orbit.target.set(...told.centre);
    camera.position.set(...told.view).multiplyScalar(0.8 * away).add(orbit.target);
    orbit.update();
    request();
  }

  let asked = 0;
  function request() {
    if (!asked) asked = requestAnimationFrame(render);
  }
  function render() {
    asked = 0;
    const width = stage.clientWidth;
    const height = stage.clientHeight;
    if (!width || !height) return;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    if (stage.width !== Math.round(width * ratio) || stage.height !== Math.round(height * ratio)) {
      renderer.setPixelRatio(ratio);
      renderer.setSize(width, height, false);
      camera.aspect = width / height;
      camera.updateProjectionMatrix();
    }
    lamp.position.copy(camera.position).sub(orbit.target);
    renderer.render(scene, camera);
    stage.dataset.drawn = String(Number(stage.dataset.drawn ?? 0) + 1);
  }

  function turn(aside, up, nearer) {
    const arm = camera.position.clone().sub(orbit.target);
    const flat = Math.hypot(arm.x, arm.y);
    const angle = Math.atan2(arm.y, arm.x) + aside;
    const rise = Math.min(Math.max(Math.atan2(arm.z, flat) + up, -1.5), 1.5);
    const reach = Math.min(Math.max(arm.length() * nearer, orbit.minDistance), orbit.maxDistance);
    arm.set(Math.cos(angle) * Math.cos(rise), Math.sin(angle) * Math.cos(rise), Math.sin(rise)).multiplyScalar(reach);
    camera.position.copy(orbit.target).add(arm);
    orbit.update();
    request();
  }
  const keys = {
    ArrowLeft: () => turn(-0.1, 0, 1), ArrowRight: () => turn(0.1, 0, 1), ArrowUp: () => turn(0, 0.08, 1),
    ArrowDown: () => turn(0, -0.08, 1), "+": () => turn(0, 0, 0.87), "=": () => turn(0, 0, 0.87),
    "-": () => turn(0, 0, 1.15), 0: home, " ": clock.toggle,
  };
  stage.addEventListener("keydown", (event) => {
    if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    keys[event.key]();
  });
  orbit.addEventListener("change", request);
  document.getElementById("view").addEventListener("click", home);
  new ResizeObserver(request).observe(stage);
  document.addEventListener("themechange", paint);
  page.on("recording", choose);
  magnify.addEventListener("change", () => {
    byHand = true;
    tell();
    at(clock.state.now);
  });
  page.on("parts", () => at(clock.state.now));
  clock.on((state) => at(state.now));
  camera.aspect = (stage.clientWidth || 16) / (stage.clientHeight || 10);
  camera.updateProjectionMatrix();
  home();
  paint();
})();
