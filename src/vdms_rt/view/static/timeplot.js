// One coordinate against time: a line, and one sigma to each side as a band.

import uPlot from "/static/vendor/uPlot.esm.js";
import { clock, colour } from "/static/format.js";

const LEAST_MM = 0.01;
const GAP_PERIODS = 1.6;
const RIGHT_PX = 6;
const CHARACTER_PX = 7; // of a time's label, at most

/** Points to draw from one time to another: [t, v - sigma, v + sigma, v], null where nothing is.
 * Where samples are denser than pixels, the lowest and highest of each pixel stay. */
export function points(store, axis, from_s, to_s, width_px, out) {
  for (const column of out) column.length = 0;
  const begin = Math.max(store.place(from_s) - 1, store.begin), end = Math.min(store.place(to_s) + 1, store.end);
  const t = store.slice("t_s", begin, end), v = store.slice(axis, begin, end);
  const sigma = store.slice(`sigma_${axis}`, begin, end);
  const gap_s = GAP_PERIODS * store.period_s();
  const put = (i) => {
    const none = Number.isNaN(v[i]);
    out[0].push(t[i]);
    out[1].push(none ? null : v[i] - sigma[i]);
    out[2].push(none ? null : v[i] + sigma[i]);
    out[3].push(none ? null : v[i]);
  };
  const each = Math.max(Math.floor(t.length / width_px), 1);
  for (let i = 0; i < t.length; i += each) {
    if (i && t[i] - t[i - 1] > gap_s) {
      out[0].push((t[i] + t[i - 1]) / 2);
      for (const column of out.slice(1)) column.push(null);
    }
    if (each < 3) {
      for (let j = i; j < Math.min(i + each, t.length); j++) put(j);
      continue;
    }
    let low = i, high = i, none = -1;
    for (let j = i; j < Math.min(i + each, t.length); j++) {
      if (Number.isNaN(v[j]) || (j > i && t[j] - t[j - 1] > gap_s)) none = j;
      if (v[j] < v[low] || Number.isNaN(v[low])) low = j;
      if (v[j] > v[high] || Number.isNaN(v[high])) high = j;
    }
    const kept = new Set([low, high, ...(none >= 0 && Number.isNaN(v[none]) ? [none] : [])]);
    for (const j of [...kept].sort((a, b) => a - b)) put(j);
  }
  return out;
}

/** The label of a time, or nothing where the plot's edge would cut it off. */
export function whole(u, s, text) {
  const room_px = u.bbox.width / devicePixelRatio + RIGHT_PX - u.valToPos(s, "x");
  return (text.length * CHARACTER_PX) / 2 <= room_px ? text : "";
}

export class TimePlot {
  /** `view` has from_s and to_s, and is told of zoom(from_s, to_s) and cursor(t_s or null). */
  constructor(root, axis, store, view) {
    Object.assign(this, { root, axis, store, view, data: [[], [], [], []], range: [-1, 1] });
    const ink = () => colour("--muted"), grid = { stroke: () => colour("--grid"), width: 1 };
    const line = () => colour(`--${axis}`), none = { show: false };
    this.plot = new uPlot({
      width: 400, height: 120, padding: [8, RIGHT_PX, 0, 0], legend: none, pxAlign: 0,
      scales: { x: { time: true, range: () => [view.from_s, view.to_s] }, y: { range: () => this.range } },
      axes: [
        { stroke: ink, grid, ticks: grid, size: 26, space: 90, values: (u, at, _, __, step) => at.map((s) => whole(u, s, clock(s, clock_digits(step)))) },
        { stroke: ink, grid, ticks: grid, size: 68, space: 26, values: (u, at) => at.map((v) => v.toFixed(decimals(this.range))) },
      ],
      series: [
        {},
        { stroke: "transparent", width: 0, points: none },
        { stroke: "transparent", width: 0, points: none },
        { stroke: line, width: 2, points: none },
      ],
      bands: [{ series: [2, 1], fill: () => `color-mix(in srgb, ${line()} 35%, transparent)` }],
      cursor: { sync: { key: "time" }, y: false, drag: { x: true, y: false, setScale: false }, points: { size: 9 } },
      hooks: {
        setSelect: [(u) => this.selected(u)],
        setCursor: [(u) => view.cursor(u.cursor.idx == null || u.cursor.left < 0 ? null : this.data[0][u.cursor.idx])],
      },
    }, this.data, root);
    this.plot.over.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    this.plot.over.addEventListener("dblclick", () => view.live());
    this.touch();
    new ResizeObserver(() => this.resize()).observe(root);
    this.resize();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.root;
    if (width > 60 && height > 40) this.plot.setSize({ width, height });
  }

  draw() {
    const { from_s, to_s } = this.view;
    points(this.store, this.axis, from_s, to_s, this.plot.over.clientWidth || 600, this.data);
    this.range = room(this.data, this.range);
    this.plot.setData(this.data);
  }

  /** Draw again in the other theme's colours. */
  repaint() {
    this.plot.redraw(false, true);
  }

  selected(u) {
    if (u.select.width < 4) return;
    const from_s = u.posToVal(u.select.left, "x"), to_s = u.posToVal(u.select.left + u.select.width, "x");
    u.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
    this.view.zoom(from_s, to_s);
  }

  wheel(event) {
    event.preventDefault();
    const at_s = this.plot.posToVal(event.offsetX, "x");
    this.view.scale(event.deltaY > 0 ? 1.25 : 0.8, at_s);
  }

  /** A finger moves the stretch that is seen. */
  touch() {
    const over = this.plot.over;
    over.style.touchAction = "pan-y";
    let last_px = null;
    over.addEventListener("pointerdown", (event) => { last_px = event.pointerType === "touch" ? event.clientX : null; });
    over.addEventListener("pointermove", (event) => {
      if (last_px === null || event.pointerType !== "touch") return;
      this.view.pan(((last_px - event.clientX) / over.clientWidth) * (this.view.to_s - this.view.from_s));
      last_px = event.clientX;
    });
    over.addEventListener("pointerup", () => { last_px = null; });
  }
}

/** Digits of a second that tell times of such a step apart. */
function clock_digits(step_s) {
  return [0, 1, 2].find((digits) => Math.abs(step_s * 10 ** digits - Math.round(step_s * 10 ** digits)) < 1e-6) ?? 3;
}

function decimals([low, high]) {
  return Math.min(Math.max(Math.ceil(1.3 - Math.log10(high - low)), 0), 5);
}

/** A range that holds the data; it stays as long as the data fills half of it. */
function room(data, range) {
  let low = Infinity, high = -Infinity;
  for (let i = 0; i < data[0].length; i++) {
    if (data[1][i] === null) continue;
    if (data[1][i] < low) low = data[1][i];
    if (data[2][i] > high) high = data[2][i];
  }
  if (low > high) return range;
  const span = Math.max(high - low, LEAST_MM);
  if (low >= range[0] && high <= range[1] && span > 0.5 * (range[1] - range[0])) return range;
  const middle = (low + high) / 2;
  return [middle - 0.6 * span, middle + 0.6 * span];
}
