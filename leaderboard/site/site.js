// Sorting, filtering, switches, copying and the theme, and the page's address, which says what is chosen. Every page can be read without it.
"use strict";

const root = document.documentElement;
const KEY = "cudc-bench-theme";
const THEMES = ["light", "dark"];
const CARRIED = ["milestone", "scale", "beside", "theme"]; // what holds on the next page, too

function remembered() {
  try {
    return localStorage.getItem(KEY);
  } catch {
    return null; // Storage may be forbidden.
  }
}

// Before anything is drawn.
const asked = new URLSearchParams(location.search);
root.classList.add("js");
const theme = [asked.get("theme"), remembered()].find((one) => THEMES.includes(one));
if (theme) root.dataset.theme = theme;

// What is chosen stands in the address, so that it can be passed on; null takes it away.
function say(name, value) {
  const found = new URLSearchParams(location.search);
  if (value === null) found.delete(name);
  else if (Array.isArray(value)) {
    found.delete(name);
    for (const one of value) found.append(name, one);
  } else found.set(name, value);
  const text = found.toString();
  try {
    history.replaceState(null, "", `${location.pathname}${text ? `?${text}` : ""}${location.hash}`);
  } catch {
    // Where that is forbidden, pages work as they are.
  }
}

// A link to another page takes along what holds there, too.
function carry(event) {
  const link = event.target.closest && event.target.closest("a[href]");
  if (!link || link.protocol !== location.protocol || link.host !== location.host || !link.pathname.endsWith(".html")) return;
  const now = new URLSearchParams(location.search);
  const kept = new URLSearchParams(CARRIED.filter((one) => now.has(one)).map((one) => [one, now.get(one)]));
  link.search = kept.toString();
}

function setUpTheme() {
  const button = document.getElementById("theme");
  const system = matchMedia("(prefers-color-scheme: dark)");
  const isDark = () => (root.dataset.theme ? root.dataset.theme === "dark" : system.matches);
  const show = () => {
    button.textContent = isDark() ? "Light mode" : "Dark mode";
  };
  button.addEventListener("click", () => {
    root.dataset.theme = isDark() ? "light" : "dark";
    try {
      localStorage.setItem(KEY, root.dataset.theme);
    } catch {
      // It holds for this page, then.
    }
    say("theme", root.dataset.theme);
    show();
  });
  system.addEventListener("change", show);
  show();
  button.hidden = false;
}

// A cell's key: numbers as numbers, others as text, null for a missing one.
function keyOf(row, index, numeric) {
  const cell = row.cells[index];
  if (!cell || cell.hasAttribute("data-missing")) return null;
  if (cell.hasAttribute("data-value")) return Number(cell.dataset.value);
  const text = cell.textContent.trim();
  if (!numeric) return text.toLowerCase();
  const number = Number(text.replaceAll(",", ""));
  return text === "" || Number.isNaN(number) ? null : number;
}

function compare(a, b) {
  if (typeof a === "number" && typeof b === "number") return a - b;
  return String(a).localeCompare(String(b), "en", { numeric: true });
}

function sortBy(table, head, descending) {
  const body = table.tBodies[0];
  const numeric = head.dataset.sort === "number";
  const keyed = [...body.rows].map((row, place) => ({ row, place, key: keyOf(row, head.cellIndex, numeric) }));
  keyed.sort((a, b) => {
    // Missing cells are last in either direction, and rows that are alike keep their places.
    if ((a.key === null) !== (b.key === null)) return a.key === null ? 1 : -1;
    const order = a.key === null ? 0 : compare(a.key, b.key);
    return (descending ? -order : order) || a.place - b.place;
  });
  body.append(...keyed.map(({ row }) => row));
  for (const other of head.parentElement.cells) {
    if (other.dataset.sort) other.setAttribute("aria-sort", "none");
  }
  head.setAttribute("aria-sort", descending ? "descending" : "ascending");
}

const headsOf = (table) => [...table.tHead.rows[table.tHead.rows.length - 1].cells];

// In the address a table is the id of its caption, and a column its number.
function sortedBy(table, index, descending) {
  const others = new URLSearchParams(location.search).getAll("sort").filter((one) => !one.startsWith(`${table.caption.id}~`));
  say("sort", [...others, `${table.caption.id}~${index}~${descending ? "down" : "up"}`]);
}

function setUpSorting(table) {
  for (const head of headsOf(table)) {
    if (!head.dataset.sort) continue;
    if (!head.hasAttribute("aria-sort")) head.setAttribute("aria-sort", "none");
    const button = document.createElement("button");
    button.type = "button";
    button.className = "sort";
    const link = head.querySelector("a");
    if (link) {
      // A head that leads somewhere keeps its link; the button stands behind it.
      const name = document.createElement("span");
      name.className = "unseen";
      name.textContent = `Sort by ${link.textContent}`;
      button.append(name);
      head.append(" ", button);
    } else {
      button.append(...head.childNodes);
      head.append(button);
    }
    button.addEventListener("click", () => {
      const now = head.getAttribute("aria-sort");
      // Of numbers one wants the largest first.
      const first = head.dataset.sort === "number" ? "descending" : "ascending";
      const descending = now === "none" ? first === "descending" : now === "ascending";
      sortBy(table, head, descending);
      sortedBy(table, head.cellIndex, descending);
    });
  }
}

function restoreSorting() {
  for (const one of asked.getAll("sort")) {
    const [id, index, order] = one.split("~");
    const table = document.getElementById(id)?.closest("table");
    const head = table && headsOf(table)[Number(index)];
    if (head && head.dataset.sort) sortBy(table, head, order === "down");
  }
}

function setUpSwitches(form) {
  const tables = [...document.querySelectorAll("table.filtered")];
  const field = form.elements.namedItem("filter");
  const filter = () => {
    const found = document.getElementById("found");
    if (!field) return;
    const wanted = field.value.trim().toLowerCase();
    const names = new Map();
    for (const table of tables) {
      for (const row of table.tBodies[0].rows) {
        const name = row.cells[0].textContent.trim();
        // The name, and what stands next to it if that is a word, such as a dataset's method.
        const words = [...row.cells].slice(0, 2).filter((cell) => !cell.classList.contains("number"));
        const shown = words.some((cell) => cell.textContent.toLowerCase().includes(wanted));
        row.hidden = !shown;
        names.set(name, names.get(name) || shown);
      }
    }
    const shown = [...names.values()].filter(Boolean).length;
    found.textContent = wanted ? `${shown} of ${names.size} shown` : "";
  };
  const apply = () => {
    const data = new FormData(form);
    const milestone = data.get("milestone");
    if (milestone) {
      for (const part of document.querySelectorAll("[data-milestone]")) {
        part.toggleAttribute("hidden", milestone !== "all" && part.dataset.milestone !== milestone);
      }
    }
    root.dataset.scale = data.get("scale") || "raw";
    root.dataset.beside = data.get("beside") ? "on" : "off";
  };
  // What differs from how the page is written.
  const tell = () => {
    for (const one of form.elements) {
      if (one.type === "radio" && one.checked) say(one.name, one.defaultChecked ? null : one.value);
      if (one.type === "checkbox") say(one.name, one.checked ? "on" : null);
    }
  };
  const choose = (name, value) => {
    for (const one of form.elements) {
      if (one.name !== name) continue;
      if (one.type === "radio" && one.value === value) one.checked = true;
      if (one.type === "checkbox") one.checked = value === "on";
    }
  };
  for (const name of ["milestone", "scale", "beside"]) if (asked.has(name)) choose(name, asked.get(name));
  if (field && asked.has("filter")) field.value = asked.get("filter");
  form.addEventListener("submit", (event) => event.preventDefault());
  form.addEventListener("input", (event) => {
    if (event.target === field) {
      filter();
      say("filter", field.value || null);
    } else {
      apply();
      tell();
    }
  });
  form.hidden = false;
  // A browser that comes back to a page may have kept what was chosen.
  apply();
  filter();
}

async function copy(text) {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    return false; // Not allowed there: the text is selected instead.
  }
}

function setUpCopying(button) {
  const source = button.parentElement.querySelector("pre");
  button.addEventListener("click", async () => {
    const done = await copy(source.textContent);
    if (!done) getSelection().selectAllChildren(source);
    document.getElementById("said").textContent = done ? "Copied." : "Selected; copy it with the keyboard.";
    button.classList.toggle("done", done);
    setTimeout(() => button.classList.remove("done"), 1500);
  });
  button.hidden = false;
}

// What a link leads to must be seen, even inside of what is folded.
function unfold() {
  const target = location.hash.length > 1 && document.getElementById(location.hash.slice(1));
  for (let one = target; one; one = one.parentElement) if (one.tagName === "DETAILS") one.open = true;
}

document.addEventListener("DOMContentLoaded", () => {
  setUpTheme();
  document.querySelectorAll("table").forEach((table) => setUpSorting(table));
  document.querySelectorAll("button.copy").forEach(setUpCopying);
  const form = document.getElementById("switches");
  if (form) setUpSwitches(form);
  restoreSorting();
  unfold();
  addEventListener("hashchange", unfold);
  for (const kind of ["click", "auxclick"]) document.addEventListener(kind, carry, true);
});
