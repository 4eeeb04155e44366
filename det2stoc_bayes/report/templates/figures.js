"use strict";
(() => {
  const theme = window.matchMedia("(prefers-color-scheme: dark)");
  const coarse = window.matchMedia("(pointer: coarse)").matches;
  const drawn = new Set();

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
    Plotly.react(place, data, layout, { displayModeBar: false, doubleClick: "reset" });
    drawn.add(place);
  }

  const visible = (place) => place.offsetParent !== null && place.clientWidth > 0;
  const drawIn = (part) => part.querySelectorAll(".figure").forEach((place) => { if (visible(place)) draw(place); });
  const redraw = () => drawn.forEach((place) => { if (visible(place)) draw(place); });

  // A figure is drawn when it comes near the screen, and again when what hid it opens.
  const seen = new IntersectionObserver((entries) => {
    entries.filter((entry) => entry.isIntersecting).forEach((entry) => draw(entry.target));
  }, { rootMargin: "300px" });
  document.querySelectorAll(".figure").forEach((place) => seen.observe(place));
  document.querySelectorAll("details").forEach((part) => {
    part.addEventListener("toggle", () => { if (part.open) drawIn(part); });
  });
  theme.addEventListener("change", redraw);
  window.addEventListener("beforeprint", () => drawIn(document.body));
  let width = window.innerWidth;
  let waiting = 0;
  window.addEventListener("resize", () => {
    if (window.innerWidth === width) return;
    width = window.innerWidth;
    clearTimeout(waiting);
    waiting = setTimeout(redraw, 120);
  });

  const select = document.getElementById("recording");
  if (!select) return;
  function show(index) {
    select.selectedIndex = index;
    document.querySelectorAll(".recording").forEach((part, i) => {
      part.hidden = i !== index;
      if (i === index) drawIn(part);
    });
    document.getElementById("previous").disabled = index === 0;
    document.getElementById("next").disabled = index === select.options.length - 1;
  }
  select.addEventListener("change", () => show(select.selectedIndex));
  document.getElementById("previous").addEventListener("click", () => show(select.selectedIndex - 1));
  document.getElementById("next").addEventListener("click", () => show(select.selectedIndex + 1));
  show(0);
})();
