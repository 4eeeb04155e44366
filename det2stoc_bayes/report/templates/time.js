"use strict";
// One moment for all: the slider, the line in every plot over time, and the replay. Zoom over time is shared, too.
const clock = (() => {
  const slider = document.getElementById("time");
  if (!slider) return null;
  const play = document.getElementById("play");
  const told = document.getElementById("now");
  const speed = document.getElementById("speed");
  const listeners = [];
  const state = { begin: 0, end: 1, now: 0, playing: false, range: null };
  let last = 0;
  let spreading = false;

  const plots = () => [...page.drawn].filter((place) => place.matches("[data-time]") && page.visible(place));

  function mark(place) {
    const layout = place._fullLayout;
    const line = place.querySelector(":scope > .cursor");
    if (!layout || !line) return;
    const axis = layout.xaxis;
    const x = axis.l2p(state.now);
    line.hidden = !(x >= 0 && x <= axis._length);
    line.style.transform = `translateX(${axis._offset + x}px)`;
    line.style.top = `${layout._size.t}px`;
    line.style.height = `${layout._size.h}px`;
  }

  function set(time) {
    state.now = Math.min(Math.max(time, state.begin), state.end);
    slider.value = state.now;
    const text = `${state.now.toFixed(state.end - state.begin < 20 ? 2 : 1)} s`;
    told.textContent = text;
    slider.setAttribute("aria-valuetext", text);
    plots().forEach(mark);
    listeners.forEach((action) => action(state));
  }

  function run(playing) {
    state.playing = playing;
    play.textContent = playing ? "❚❚" : "▶";
    play.setAttribute("aria-label", playing ? "Pause" : "Play");
    if (!playing) return;
    if (state.now >= state.end) set(state.begin);
    last = performance.now();
    requestAnimationFrame(tick);
  }

  function tick(moment) {
    if (!state.playing) return;
    set(state.now + Math.max(moment - last, 0) / 1000 * Number(speed.value));
    last = moment;
    if (state.now >= state.end) run(false);
    else requestAnimationFrame(tick);
  }

  function zoom(range) {
    state.range = range;
    const change = range ? { "xaxis.range": range } : { "xaxis.autorange": true };
    spreading = true;
    Promise.all(plots().map((place) => Plotly.relayout(place, change))).finally(() => {
      spreading = false;
      plots().forEach(mark);
    });
  }

  // By `factor` about the line, within the recording.
  function scale(factor) {
    const [low, high] = state.range ?? [state.begin, state.end];
    const width = (high - low) * factor;
    if (width >= state.end - state.begin) return zoom(null);
    const middle = state.now >= low && state.now <= high ? state.now : (low + high) / 2;
    const begin = Math.min(Math.max(middle - width / 2, state.begin), state.end - width);
    return zoom([begin, begin + width]);
  }

  function follow(place) {
    const to = (event) => {
      const axis = place._fullLayout.xaxis;
      const x = event.clientX - place.getBoundingClientRect().left - axis._offset;
      if (x >= 0 && x <= axis._length) set(axis.p2l(x));
    };
    place.addEventListener("pointermove", (event) => { if (!state.playing && !event.buttons) to(event); });
    place.addEventListener("pointerdown", (event) => { if (event.pointerType !== "mouse") { run(false); to(event); } });
    place.on("plotly_relayout", (event) => {
      if (spreading) return;
      if (event["xaxis.range"] || "xaxis.range[0]" in event) zoom([...place._fullLayout.xaxis.range]);
      else if (event["xaxis.autorange"]) zoom(null);
    });
  }

  page.on("draw", (place, first) => {
    if (!place.matches("[data-time]")) return;
    if (!place.querySelector(":scope > .cursor")) {
      const line = document.createElement("i");
      line.className = "cursor";
      place.append(line);
    }
    if (first) follow(place);
    if (state.range) Plotly.relayout(place, { "xaxis.range": state.range });
    mark(place);
  });
  page.on("recording", (part) => {
    run(false);
    state.range = null;
    [state.begin, state.end] = [Number(part.dataset.begin), Number(part.dataset.end)];
    [slider.min, slider.max] = [state.begin, state.end];
    slider.step = (state.end - state.begin) / 300;
    set(Number(part.dataset.worst)); // where most is to be seen
  });
  slider.addEventListener("input", () => { run(false); set(Number(slider.value)); });
  play.addEventListener("click", () => run(!state.playing));
  document.getElementById("zoom-in").addEventListener("click", () => scale(0.5));
  document.getElementById("zoom-out").addEventListener("click", () => scale(2));
  document.getElementById("zoom-all").addEventListener("click", () => zoom(null));
  return { state, set, toggle: () => run(!state.playing), on: (action) => listeners.push(action) };
})();
