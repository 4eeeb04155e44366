"use strict";
// The list: rows by words and kind, and two of them for a comparison.
(() => {
  const filter = document.getElementById("filter");
  const kind = document.getElementById("kind");
  const links = [...document.querySelectorAll("a.compare")]; // above the list and below it
  const told = document.getElementById("told");
  const rows = [...document.querySelectorAll("tbody tr")];

  function show() {
    const words = filter.value.toLowerCase().split(/\s+/).filter(Boolean);
    let count = 0;
    rows.forEach((row) => {
      const text = row.textContent.toLowerCase();
      row.hidden = !(words.every((word) => text.includes(word)) && (!kind.value || row.dataset.kind === kind.value));
      count += Number(!row.hidden);
    });
    const chosen = rows.map((row) => row.querySelector("input")).filter((box) => box.checked).map((box) => box.value);
    const ready = chosen.length === 2;
    links.forEach((link) => {
      link.setAttribute("aria-disabled", String(!ready));
      if (ready) link.href = `/compare?${new URLSearchParams({ a: chosen[0], b: chosen[1] })}`;
      else link.removeAttribute("href");
    });
    const left = chosen.length > 2 ? "Two at most can be compared." : ready ? "Enter compares them." : "Tick two to compare them.";
    told.textContent = `${count} of ${rows.length} shown. ${left}`;
  }
  filter.addEventListener("input", show);
  kind.addEventListener("change", show);
  rows.map((row) => row.querySelector("input")).forEach((box) => {
    box.addEventListener("change", show);
    box.addEventListener("keydown", (event) => {
      if (event.key === "Enter" && box.checked && links[0].href) location.assign(links[0].href);
    });
  });
  show();
})();
