"use strict";
// Draws the figures of the page in the colours of its theme, and plays runs.
let content = null;
const root = document.documentElement;
const THEMES = {
  light: {
    ink: "#1c2024", muted: "#7a838d", grid: "#e3e7eb", paper: "#ffffff", blue: "#0072B2",
    orange: "#D55E00", green: "#009E73", purple: "#CC79A7", sky: "#56B4E9", yellow: "#B8860B",
  },
  dark: {
    ink: "#e8eaed", muted: "#98a2ad", grid: "#303841", paper: "#15181c", blue: "#56B4E9",
    orange: "#F28E2B", green: "#2CC79A", purple: "#E3A3C4", sky: "#9AD5F5", yellow: "#F0E442",
  },
};
const colours = () => THEMES[root.dataset.theme];
const PRINT_WIDTH = 690;

// A colour that begins with @ is one of the theme.
function themed(value) {
  if (typeof value === "string" && value.startsWith("@")) return colours()[value.slice(1)] || value;
  if (Array.isArray(value)) return value.length && typeof value[0] === "number" ? value : value.map(themed);
  if (value && typeof value === "object") {
    return Object.fromEntries(Object.entries(value).map(([k, v]) => [k, themed(v)]));
  }
  return value;
}

const LEGEND_ENTRY = 190, LEGEND_LINE = 20, NARROW = 520;

// The layout of a figure of this height [pixel], with room for its legend below it.
function laidOut(layout, height, data, width) {
  const c = colours();
  const made = {
    font: { color: c.ink, size: 12 }, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
    margin: { l: 56, r: 16, t: 28, b: 48 }, height, hovermode: "closest",
    legend: { orientation: "h", y: -0.2, yanchor: "top", x: 0 }, ...themed(layout),
  };
  if (made.showlegend) {
    const entries = data.filter((trace) => trace.showlegend !== false).length;
    const lines = Math.ceil(entries / Math.max(1, Math.floor(width / LEGEND_ENTRY)));
    made.height += LEGEND_LINE * (lines - 1);
    made.margin.b = 64 + LEGEND_LINE * lines;
    const title = made.xaxis && made.xaxis.title && made.xaxis.title.text;
    const below = 54 + (width < NARROW && title && broken(title) !== title ? 16 : 0);
    made.margin.b += below - 54;
    made.height += below - 54;
    made.legend.y = -below / (made.height - made.margin.t - made.margin.b);
  }
  for (const side of ["xaxis", "yaxis"]) made[side] = made[side] || {};
  for (const key of Object.keys(made)) {
    if (/^[xy]axis\d*$/.test(key)) {
      made[key] = { gridcolor: c.grid, zerolinecolor: c.muted, linecolor: c.muted, zeroline: false, ...made[key] };
      const title = made[key].title && made[key].title.text;
      if (title && key.startsWith("x") && width < NARROW) made[key].title = { ...made[key].title, text: broken(title) };
    }
  }
  return made;
}

// A long title in two lines, broken at a space.
function broken(text) {
  const at = text.length > 30 ? text.indexOf(" ", text.length / 2 - 4) : -1;
  return at < 0 ? text : `${text.slice(0, at)}<br>${text.slice(at + 1)}`;
}

const CONFIG = { responsive: true, displaylogo: false, modeBarButtons: [["toImage", "resetScale2d"]] };

// The buttons of a figure are for the mouse: by keyboard they would be in the way.
function quiet(div) {
  for (const button of div.querySelectorAll(".modebar-btn")) button.tabIndex = -1;
}

function draw(div) {
  const figure = content.figures[div.dataset.figure];
  div.dataset.drawn = "yes";
  const choice = document.querySelector(`select[data-of="${div.dataset.figure}"]`);
  let data = themed(figure.data);
  if (choice) {
    data = data.map((trace, k) => ({ ...trace, y: figure.choices[choice.value][k] }));
  }
  const layout = laidOut(figure.layout, figure.height, data, div.clientWidth);
  if (choice) layout.yaxis.title = { text: choice.value };
  div.style.height = `${layout.height}px`;
  if (choice && figure.titles[choice.value]) {
    div.closest("figure").querySelector("h3").textContent = figure.titles[choice.value];
  }
  return Plotly.react(div, data, layout, CONFIG).then(() => quiet(div));
}

const plots = [...document.querySelectorAll(".plot[data-figure]")];
const watcher = new IntersectionObserver((entries) => {
  for (const entry of entries) {
    if (!entry.isIntersecting) continue;
    watcher.unobserve(entry.target);
    if (!entry.target.dataset.drawn) draw(entry.target);
  }
}, { rootMargin: "600px" });

for (const select of document.querySelectorAll("select[data-of]")) {
  select.addEventListener("change", () => draw(document.querySelector(`.plot[data-figure="${select.dataset.of}"]`)));
}

// The floors of a map as an image below paths, and a marker of each for the legend.
const FLOOR_TINTS = [["yellow", 0.16], ["sky", 0.34], ["purple", 0.3], ["muted", 0.3]];
function floorTraces(map) {
  const tints = map.surfaces.map((_, k) => {
    const [name, alpha] = FLOOR_TINTS[k % FLOOR_TINTS.length];
    const rgb = colours()[name].match(/\w\w/g).map((hex) => parseInt(hex, 16));
    return `rgba(${rgb}, ${alpha / (1 + Math.floor(k / FLOOR_TINTS.length))})`;
  });
  const steps = tints.flatMap((tint, k) => [[k / tints.length, tint], [(k + 1) / tints.length, tint]]);
  const image = {
    type: "heatmap", z: map.cells, text: map.cells.map((row) => row.map((k) => map.surfaces[k])),
    x0: map.corner[0] + map.cell[0] / 2, dx: map.cell[0], y0: map.corner[1] + map.cell[1] / 2, dy: map.cell[1],
    colorscale: steps, zmin: -0.5, zmax: tints.length - 0.5, showscale: false, hovertemplate: "%{text}<extra></extra>",
  };
  const marks = map.surfaces.map((name, k) => ({
    x: [null], y: [null], mode: "markers", name: `floor: ${name}`, hoverinfo: "skip",
    marker: { symbol: "square", size: 12, color: tints[k], line: { width: 1, color: colours().muted } },
  }));
  return [image, ...marks];
}

// The ranges of axes that show all tracks with a margin.
function ranges(tracks) {
  const spans = [0, 1].map((k) => tracks.flatMap((track) => [Math.min(...track[k]), Math.max(...track[k])]));
  const ends = spans.map((of) => [Math.min(...of) / 1000, Math.max(...of) / 1000]);
  const margin = 0.1 + 0.1 * Math.max(...ends.map(([low, high]) => high - low));
  return ends.map(([low, high]) => [low - margin, high + margin]);
}

// Paths of runs.
const groupOf = (run) => (run.map === null ? run.floor : "several floors");
class Player {
  constructor(box, { runs, maps, models }) {
    Object.assign(this, { box, runs, maps, models, timer: null });
    for (const name of ["run", "time", "play", "state", "map", "off"]) this[name] = box.querySelector(`.${name}`);
    for (const floor of new Set(runs.map(groupOf))) {
      const group = document.createElement("optgroup");
      group.label = floor;
      runs.forEach((run, k) => {
        if (groupOf(run) === floor) group.append(new Option(`${run.name} (ends ${run.error} mm off)`, k));
      });
      this.run.append(group);
    }
    this.run.addEventListener("change", () => this.show());
    this.time.addEventListener("input", () => { this.stop(); this.move(); });
    this.play.addEventListener("click", () => (this.timer ? this.stop() : this.start()));
    box.querySelector(".previous").addEventListener("click", () => this.step(-1));
    box.querySelector(".next").addEventListener("click", () => this.step(1));
    this.show();
  }

  step(by) {
    const order = [...this.run.options].map((o) => o.value);
    const at = order.indexOf(this.run.value);
    this.run.value = order[(at + by + order.length) % order.length];
    this.show();
  }

  get shown() { return this.runs[Number(this.run.value)]; }

  get lines() {
    const run = this.shown, c = colours();
    const shades = { nominal: c.orange, calibrated: c.green, contact: c.blue };
    const dashes = { nominal: "dot", calibrated: "dash", contact: "solid" };
    const lines = [{ label: "measured", track: run.measured, shade: c.muted, dash: "solid", width: 6 }];
    for (const [name, track] of Object.entries(run.models)) {
      const chosen = name === run.selected;
      lines.push({
        name, label: this.models[name] + (chosen ? " (selected)" : ""), track, chosen,
        shade: shades[name] || c.purple, dash: dashes[name] || "solid", width: chosen ? 3 : 2,
      });
    }
    return lines;
  }

  show() {
    this.stop();
    this.time.max = this.shown.time.length - 1;
    this.time.value = this.time.max;
    const run = this.shown, c = colours();
    const traces = [];
    for (const line of this.lines) {
      const [x, y] = line.track.slice(0, 2).map((v) => v.map((mm) => mm / 1000));
      const style = { color: line.shade, width: line.width, dash: line.dash };
      traces.push({ x, y, mode: "lines", name: line.label, line: style, opacity: line.name ? 1 : 0.45, hoverinfo: "name" });
      traces.push({ x: [x.at(-1)], y: [y.at(-1)], mode: "markers", showlegend: false, hoverinfo: "skip",
        marker: { color: line.shade, size: line.chosen ? 11 : 8 } });
    }
    traces.push({ x: [], y: [], mode: "lines", fill: "toself", name: "90 % region", hoverinfo: "skip",
      showlegend: Boolean(run.region), line: { color: c.blue, width: 1 }, opacity: 0.5 });
    const map = run.map === null ? null : this.maps[run.map];
    if (map) traces.push(...floorTraces(map));
    const [x, y] = map ? ranges(this.lines.map((line) => line.track)) : [null, null];
    const layout = laidOut({
      xaxis: { title: { text: "x [m]" }, automargin: true, range: x },
      yaxis: { title: { text: "y [m]" }, scaleanchor: "x", automargin: true, range: y }, showlegend: true,
    }, 480, traces, this.map.clientWidth);
    this.map.style.height = `${layout.height}px`;
    this.drawn = Plotly.react(this.map, traces, layout, CONFIG);
    this.map.dataset.drawn = "yes";
    this.errors = this.lines.filter((line) => line.name).map((line) => ({
      line, mm: run.time.map((_, k) => Math.hypot(line.track[0][k] - run.measured[0][k], line.track[1][k] - run.measured[1][k])),
    }));
    const over = this.errors.map(({ line, mm }) => ({
      x: run.time, y: mm, mode: "lines", name: line.label, line: { color: line.shade, width: line.width, dash: line.dash },
    }));
    const axes = laidOut({
      xaxis: { title: { text: "time [s]" } }, yaxis: { title: { text: "distance [mm]" }, rangemode: "tozero" },
      showlegend: false, shapes: [this.cursor(run.time.at(-1))],
    }, 240, over, this.off.clientWidth);
    Plotly.react(this.off, over, axes, CONFIG).then(() => quiet(this.off));
    this.drawn.then(() => quiet(this.map));
    this.off.dataset.drawn = "yes";
    this.move();
  }

  cursor(time) {
    return { type: "line", x0: time, x1: time, y0: 0, y1: 1, yref: "paper", line: { color: colours().muted, width: 1 } };
  }

  move() {
    const run = this.shown, k = Number(this.time.value);
    this.time.setAttribute("aria-valuetext", `${run.time[k].toFixed(1)} s`);
    const ends = this.lines.map((line) => [line.track[0][k] / 1000, line.track[1][k] / 1000]);
    const heads = ends.map((_, n) => 2 * n + 1);
    Plotly.restyle(this.map, { x: ends.map((e) => [e[0]]), y: ends.map((e) => [e[1]]) }, heads);
    const region = this.region(run, k);
    Plotly.restyle(this.map, { x: [region[0]], y: [region[1]] }, [2 * ends.length]);
    Plotly.relayout(this.off, { shapes: [this.cursor(run.time[k])] });
    const errors = this.errors.map(({ line, mm }) => {
      const turned = (line.track[2][k] - run.measured[2][k]) * (180 / Math.PI / 1000);
      const heading = run.headings ? ` and ${Math.abs(turned).toFixed(1)} deg` : "";
      return `${line.label} ${mm[k].toFixed(0)} mm${heading}`;
    });
    const speed = run.speed === null ? "" : `, commanded ${run.speed} m/s`;
    this.state.textContent = `${run.map === null ? run.floor : "Several floors"}, load ${run.load}${speed}: ${run.path.toFixed(2)} m. ` +
      `After ${run.time[k].toFixed(1)} s off by: ${errors.join(", ")}.`;
  }

  // The region that was computed for the nearest point of the path at or before pose k.
  region(run, k) {
    if (!run.region) return [[], []];
    const known = run.region.edge.map((edge, n) => [Math.abs(edge - k), n]);
    const n = known.reduce((a, b) => (b[0] < a[0] ? b : a))[1];
    const at = run.region.edge[n], track = run.models[run.selected];
    const angle = run.region.angle_mrad[n] / 1000, c = Math.cos(angle), s = Math.sin(angle);
    const x = [], y = [];
    for (let j = 0; j <= 48; j++) {
      const u = run.region.major_mm[n] * Math.cos((j * Math.PI) / 24), v = run.region.minor_mm[n] * Math.sin((j * Math.PI) / 24);
      x.push((track[0][at] + c * u - s * v) / 1000);
      y.push((track[1][at] + s * u + c * v) / 1000);
    }
    return [x, y];
  }

  start() {
    if (Number(this.time.value) >= Number(this.time.max)) this.time.value = 0;
    this.play.textContent = "Pause";
    const seconds = Math.min(Math.max(this.shown.time.at(-1), 3), 12);
    this.move();
    this.timer = setInterval(() => {
      this.time.value = Number(this.time.value) + 1;
      this.move();
      if (Number(this.time.value) >= Number(this.time.max)) this.stop();
    }, (1000 * seconds) / Number(this.time.max));
  }

  stop() {
    clearInterval(this.timer);
    this.timer = null;
    this.play.textContent = "Play";
  }
}

// Numbers to copy; without the clipboard's permission the lines are selected instead.
for (const button of document.querySelectorAll(".copy")) {
  button.addEventListener("click", async () => {
    const pre = button.closest(".code").querySelector("pre");
    try {
      await navigator.clipboard.writeText(pre.textContent);
      button.textContent = "Copied";
    } catch {
      getSelection().selectAllChildren(pre);
      button.textContent = document.execCommand("copy") ? "Copied" : "Selected";
    }
    setTimeout(() => { button.textContent = "Copy"; }, 2000);
  });
}

let players = [];
const toggle = document.getElementById("theme");
function theme(name) {
  root.dataset.theme = name;
  toggle.textContent = name === "dark" ? "Light" : "Dark";
}
function remembered() {
  try { return localStorage.getItem("theme"); } catch { return null; }
}
const preferred = matchMedia("(prefers-color-scheme: dark)");
theme(remembered() || (preferred.matches ? "dark" : "light"));
function recoloured(name) {
  theme(name);
  for (const div of plots) if (div.dataset.drawn) draw(div);
  for (const player of players) player.show();
}
toggle.addEventListener("click", () => {
  const name = root.dataset.theme === "dark" ? "light" : "dark";
  try { localStorage.setItem("theme", name); } catch { /* a page without storage forgets it */ }
  recoloured(name);
});
preferred.addEventListener("change", (event) => {
  if (!remembered()) recoloured(event.matches ? "dark" : "light");
});

// Text that is packed with gzip in an element of the page.
async function unpacked(id) {
  const bytes = Uint8Array.from(atob(document.getElementById(id).textContent), (c) => c.charCodeAt(0));
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
}

async function begin() {
  const library = document.createElement("script");
  library.textContent = await unpacked("plotly");
  document.head.append(library);
  content = JSON.parse(await unpacked("content"));
  const boxes = [...document.querySelectorAll(".player")];
  players = boxes.map((box, k) => new Player(box, content.players[k]));
  plots.forEach((div) => watcher.observe(div));
  root.dataset.ready = "yes";
}
begin();

// On paper every figure is drawn, in light colours, as wide as the page.
let before = null;
addEventListener("beforeprint", () => {
  before = root.dataset.theme;
  theme("light");
  for (const div of plots) draw(div);
  for (const player of players) player.show();
  for (const details of document.querySelectorAll("details")) details.open = true;
  for (const div of document.querySelectorAll(".plot")) Plotly.relayout(div, { width: PRINT_WIDTH });
});
addEventListener("afterprint", () => {
  for (const div of document.querySelectorAll(".plot")) Plotly.relayout(div, { width: null, autosize: true });
  recoloured(before);
});
