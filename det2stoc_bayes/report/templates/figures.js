"use strict";
// Figures, drawn when they come near the screen; legends whose entries can be left out; a choice of recording.
const page = (() => {
  const coarse = window.matchMedia("(pointer: coarse)").matches;
  const drawn = new Set();
  const hidden = new Set(); // parts of the legend that are left out
  const listeners = { draw: [], recording: [], parts: [] };
  const on = (event, action) => listeners[event].push(action);
  const tell = (event, ...what) => listeners[event].forEach((action) => action(...what));

  // Colours are written as css variables; plotly wants their values.
  function resolved(value, style) {
    if (typeof value === "string") {
      const name = value.startsWith("var(") ? value.slice(4, -1) : null;
      return name ? style.getPropertyValue(name).trim() : value;
    }
    if (Array.isArray(value)) return value.map((item) => resolved(item, style));
    if (value && typeof value === "object") {
      return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, resolved(item, style)]));
    }
    return value;
  }

  function draw(place) {
    seen.unobserve(place);
    const source = JSON.parse(document.getElementById(place.dataset.source).textContent);
    const { data, layout } = resolved(source, getComputedStyle(document.documentElement));
    layout.font.family = getComputedStyle(document.body).fontFamily;
    layout.dragmode = coarse ? false : "zoom";
    layout.width = place.clientWidth;
    data.forEach((trace) => { trace.visible = !hidden.has(trace.meta); });
    Plotly.react(place, data, layout, { displayModeBar: false, doubleClick: "reset" });
    tell("draw", place, !drawn.has(place));
    drawn.add(place);
  }

  const visible = (place) => place.offsetParent !== null && place.clientWidth > 0;
  const drawIn = (part) => part.querySelectorAll(".figure").forEach((place) => { if (visible(place)) draw(place); });
  const redraw = () => drawn.forEach((place) => { if (visible(place)) draw(place); });
  const forget = () => drawn.forEach((place) => { if (!visible(place)) seen.observe(place); });

  // A figure is drawn when it comes near the screen, and again when what hid it opens.
  const seen = new IntersectionObserver((entries) => {
    entries.filter((entry) => entry.isIntersecting).forEach((entry) => draw(entry.target));
  }, { rootMargin: "300px" });
  document.querySelectorAll(".figure").forEach((place) => seen.observe(place));
  document.querySelectorAll("details").forEach((part) => {
    part.addEventListener("toggle", () => { if (part.open) drawIn(part); });
  });
  document.addEventListener("themechange", () => { redraw(); forget(); });
  window.addEventListener("beforeprint", () => drawIn(document.body));
  let width = window.innerWidth;
  let waiting = 0;
  window.addEventListener("resize", () => {
    if (window.innerWidth === width) return;
    width = window.innerWidth;
    clearTimeout(waiting);
    waiting = setTimeout(() => { redraw(); forget(); }, 120);
  });

  document.querySelectorAll(".legend button").forEach((button) => {
    button.addEventListener("click", () => {
      const part = button.dataset.part;
      if (!hidden.delete(part)) hidden.add(part);
      document.querySelectorAll(`.legend button[data-part="${part}"]`).forEach((same) => {
        same.setAttribute("aria-pressed", !hidden.has(part));
      });
      drawn.forEach((place) => {
        const traces = place.data.flatMap((trace, i) => (trace.meta === part ? [i] : []));
        if (traces.length) Plotly.restyle(place, { visible: !hidden.has(part) }, traces);
      });
      tell("parts", hidden);
    });
  });

  const select = document.getElementById("recording");
  function show(index) {
    select.selectedIndex = index;
    const parts = document.querySelectorAll(".recording");
    parts.forEach((part, i) => { part.hidden = i !== index; });
    document.getElementById("previous").disabled = index === 0;
    document.getElementById("next").disabled = index === parts.length - 1;
    tell("recording", parts[index]);
    drawIn(parts[index]);
  }
  if (select) {
    select.addEventListener("change", () => show(select.selectedIndex));
    document.getElementById("previous").addEventListener("click", () => show(select.selectedIndex - 1));
    document.getElementById("next").addEventListener("click", () => show(select.selectedIndex + 1));
  }
  return { on, hidden, drawn, visible, start: () => { if (select) show(0); } };
})();
