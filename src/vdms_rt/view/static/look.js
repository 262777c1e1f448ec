// Look: the motion now, its spectrum and its path.

import uPlot from "/static/vendor/uPlot.esm.js";
import { byId, clock, colour, define, element, length, plain, signed } from "/static/format.js";
import { peaks, spectrum } from "/static/spectrum.js";
import { figures, SPAN_S } from "/static/store.js";
import { TimePlot } from "/static/timeplot.js";

const SPANS = [[5, "5 s"], [10, "10 s"], [30, "30 s"], [60, "1 min"], [120, "2 min"], [300, "5 min"], [600, "10 min"]];
const SHORTEST_S = 0.1;
const FIGURES_MS = 250;
const VALUE_MS = 100;
const LEAST_SPECTRUM_S = 10;
const MOST_MISSING = 0.03;
/** Less is rounding, as of a fixed marker, and has no place on a logarithmic scale. */
const LEAST_MM = 1e-6;
/** The plots' right end lies so far behind the newest sample's time that there is always one. */
const BEHIND_S = 0.05;

/** Whole decades that hold both: uPlot never ends its ticks on a scale that begins between them. */
function decades(low, high) {
  const power = (exponent) => Number(`1e${exponent}`);
  const least = Math.max(low, LEAST_MM / 10);
  return [power(Math.floor(Math.log10(least))), power(Math.ceil(Math.log10(Math.max(high, 10 * least))))];
}

export class Look {
  constructor(store) {
    Object.assign(this, { store, span_s: 10, paused: false, from_s: 0, to_s: 1, dirty: true, drawn_ms: 0, cost_ms: 0, figures_ms: 0, value_ms: 0, peaks: [] });
    this.plots = ["x", "y"].map((axis) => new TimePlot(byId(`${axis}-plot`), axis, store, this));
    this.spectrum_plot = this.make_spectrum();
    this.tools();
    this.drawing = requestAnimationFrame((now) => this.frame(now));
  }

  tools() {
    const spans = byId("spans");
    for (const [s, text] of SPANS) {
      const button = element("button", { textContent: text, role: "radio" });
      button.dataset.span = s;
      button.onclick = () => { this.span_s = s; this.live(); };
      spans.append(button);
    }
    byId("pause").onclick = () => (this.paused ? this.live() : this.pause());
    byId("live").onclick = () => this.live();
    byId("zoom-in").onclick = () => this.scale(0.5);
    byId("zoom-out").onclick = () => this.scale(2);
    byId("spectrum-axis").onchange = () => { this.figures_ms = 0; this.dirty = true; };
    this.show_tools();
  }

  /** Return whether a key was one of ours. */
  key(event) {
    const step_s = (this.to_s - this.from_s) * (event.shiftKey ? 0.5 : 0.1);
    const act = {
      " ": () => (this.paused ? this.live() : this.pause()), l: () => this.live(), "+": () => this.scale(0.5), "=": () => this.scale(0.5), "-": () => this.scale(2),
      ArrowLeft: () => this.pan(-step_s), ArrowRight: () => this.pan(step_s),
    }[event.key];
    act?.();
    return act !== undefined;
  }

  show_tools() {
    for (const button of byId("spans").children) button.setAttribute("aria-checked", !this.paused && Number(button.dataset.span) === this.span_s);
    byId("pause").setAttribute("aria-pressed", this.paused);
    byId("pause").textContent = this.paused ? "Go on" : "Pause";
    byId("live").disabled = !this.paused;
    this.dirty = true;
    this.figures_ms = 0;
  }

  live() { this.paused = false; this.show_tools(); }

  pause() { this.paused = true; this.show_tools(); }

  zoom(from_s, to_s) {
    const span_s = Math.min(Math.max(to_s - from_s, SHORTEST_S), SPAN_S);
    this.from_s = (from_s + to_s) / 2 - span_s / 2;
    this.to_s = this.from_s + span_s;
    this.pause();
  }

  scale(factor, at_s = (this.from_s + this.to_s) / 2) {
    this.zoom(at_s - (at_s - this.from_s) * factor, at_s + (this.to_s - at_s) * factor);
  }

  pan(by_s) { this.zoom(this.from_s + by_s, this.to_s + by_s); }

  cursor(t_s) {
    const out = byId("cursor");
    const at = t_s === null ? -1 : this.store.place(t_s - 1e-6);
    const is = at >= this.store.begin && at < this.store.end;
    out.classList.toggle("on", is);
    if (!is) { out.textContent = "drag in a plot to zoom, point at it for values"; return; }
    const value = (name) => this.store.slice(name, at, at + 1)[0];
    out.textContent = `${clock(value("t_s"), 3)}   x ${signed(value("x"), 4)}   y ${signed(value("y"), 4)} mm   seq ${value("seq")}`;
  }

  /** Samples have come: follow the station's clock. */
  added() {
    const offset_s = performance.now() / 1000 - this.store.newest("t_s");
    if (!Number.isFinite(offset_s)) return;
    const known = Math.abs(offset_s - this.offset_s) < 1;
    this.offset_s = known ? this.offset_s + 0.04 * (offset_s - this.offset_s) : offset_s;
  }

  cleared() { this.offset_s = NaN; this.figures_ms = 0; this.live(); }

  repaint() { for (const plot of this.plots) plot.repaint(); this.spectrum_plot.redraw(false, true); this.draw_path(); }

  frame(now_ms) {
    this.drawing = requestAnimationFrame((at) => this.frame(at));
    if (byId("look").hidden || document.hidden) return;
    const px_ms = (1000 * (this.to_s - this.from_s)) / 800;
    const every_ms = Math.max(30, Math.min(px_ms, 250), 3 * this.cost_ms);
    if (this.paused ? !this.dirty : now_ms - this.drawn_ms < every_ms) return;
    this.dirty = false;
    this.drawn_ms = now_ms;
    const begin_ms = performance.now();
    if (!this.paused) {
      this.to_s = Number.isFinite(this.offset_s) ? now_ms / 1000 - this.offset_s - BEHIND_S : Date.now() / 1000;
      this.from_s = this.to_s - this.span_s;
    }
    for (const plot of this.plots) plot.draw();
    if (now_ms - this.value_ms > VALUE_MS) { this.value_ms = now_ms; this.show_values(now_ms); }
    if (now_ms - this.figures_ms > FIGURES_MS || this.paused) {
      this.figures_ms = now_ms;
      this.show_figures();
      this.draw_path();
      this.draw_spectrum();
    }
    this.cost_ms = 0.9 * this.cost_ms + 0.1 * (performance.now() - begin_ms);
  }

  show_values(now_ms) {
    const stale = !(now_ms / 1000 - this.offset_s - this.store.newest("t_s") < 1.5);
    for (const axis of ["x", "y"]) {
      const out = byId(`${axis}-value`), value = this.store.newest(axis);
      out.textContent = signed(value, 3);
      out.classList.toggle("stale", stale);
    }
  }

  show_figures() {
    for (const axis of ["x", "y"]) {
      const of = figures(this.store.between(axis, this.from_s, this.to_s));
      define(byId(`${axis}-numbers`), [
        ["sigma", length(this.store.newest(`sigma_${axis}`))], ["peak", of ? `${plain(of.peak, 3)} mm` : "–"],
        ["peak to peak", of ? `${plain(of.span, 3)} mm` : "–"], ["rms", of ? `${plain(of.rms, 3)} mm` : "–"],
      ]);
    }
  }

  make_spectrum() {
    const root = byId("spectrum"), ink = () => colour("--muted"), grid = { stroke: () => colour("--grid"), width: 1 };
    const plot = new uPlot({
      width: 320, height: 150, padding: [14, 8, 0, 0], pxAlign: 0, legend: { show: false }, cursor: { show: false },
      scales: { x: { time: false }, y: { distr: 3, range: (u, low, high) => decades(Math.max(low, high / 1e5), high) } },
      axes: [
        { stroke: ink, grid, ticks: grid, size: 26, values: (u, at) => at.map((hz, i) => (i === at.length - 1 ? `${hz} Hz` : `${hz}`)) },
        { stroke: ink, grid: { show: false }, ticks: { show: false }, size: 58, values: (u, at) => at.map((v) => (v === null ? "" : v >= 0.1 ? `${v} mm` : `${+(v * 1000).toPrecision(1)} µm`)) },
      ],
      series: [{}, { stroke: () => colour(`--${byId("spectrum-axis").value}`), width: 1.5, points: { show: false } }],
      hooks: { draw: [(u) => this.name_peaks(u)] },
    }, [[0, 1], [1, 1]], root);
    new ResizeObserver(() => { if (root.clientWidth > 60) plot.setSize({ width: root.clientWidth, height: root.clientHeight }); }).observe(root);
    return plot;
  }

  draw_spectrum() {
    const axis = byId("spectrum-axis").value;
    const from_s = Math.min(this.from_s, this.to_s - LEAST_SPECTRUM_S);
    const found = spectrum(this.store.between("t_s", from_s, this.to_s), this.store.between(axis, from_s, this.to_s), this.store.period_s());
    const moves = found?.amplitude.some((a) => a > LEAST_MM);
    this.peaks = moves ? peaks(found, 3) : [];
    byId("spectrum").style.visibility = moves ? "visible" : "hidden";
    if (moves) this.spectrum_plot.setData([found.hz.subarray(1), found.amplitude.subarray(1)]);
    const list = byId("peaks");
    const told = this.peaks.map((p) => `${p.hz.toFixed(3)} Hz  ${length(p.amplitude)}`);
    if (!told.length) told.push(found ? "no peak stands out" : "too few samples for a spectrum yet");
    if (found?.missing > MOST_MISSING) told.push(`amplitudes too small: ${plain(100 * found.missing, 0)} % missing`);
    if ([...list.children].map((li) => li.textContent).join() !== told.join()) list.replaceChildren(...told.map((text) => element("li", { textContent: text })));
  }

  name_peaks(u) {
    const { ctx } = u, scale = devicePixelRatio;
    ctx.save();
    ctx.fillStyle = colour("--ink");
    ctx.font = `600 ${12 * scale}px system-ui, sans-serif`;
    ctx.textAlign = "center";
    const named = [];
    for (const { hz, amplitude } of this.peaks) {
      const left = u.valToPos(hz, "x", true), top = u.valToPos(amplitude, "y", true);
      if (named.some((other) => Math.abs(other - left) < 32 * scale)) continue;
      named.push(left);
      const half = ctx.measureText(hz.toFixed(2)).width / 2;
      ctx.fillText(hz.toFixed(2), Math.min(Math.max(left, u.bbox.left + half + 2), u.bbox.left + u.bbox.width - half), Math.max(top - 4 * scale, 11 * scale));
    }
    ctx.restore();
  }

  draw_path() {
    const canvas = byId("path"), scale = devicePixelRatio, { clientWidth: width, clientHeight: height } = canvas;
    if (canvas.width !== width * scale || canvas.height !== height * scale) { canvas.width = width * scale; canvas.height = height * scale; }
    const ctx = canvas.getContext("2d");
    ctx.setTransform(scale, 0, 0, scale, 0, 0);
    ctx.clearRect(0, 0, width, height);
    const x = this.store.between("x", this.from_s, this.to_s), y = this.store.between("y", this.from_s, this.to_s);
    const of_x = figures(x), of_y = figures(y);
    canvas.setAttribute("aria-label", of_x ? `Path: ${plain(of_x.span, 3)} mm across, ${plain(of_y.span, 3)} mm up` : "Path: no samples");
    if (!of_x) return;
    const mm = Math.max(of_x.span / (width - 30), of_y.span / (height - 44), 1e-5);
    const middle = [(of_x.low + of_x.high) / 2, (of_y.low + of_y.high) / 2];
    const at = (i) => [width / 2 + (x[i] - middle[0]) / mm, (height - 18) / 2 - (y[i] - middle[1]) / mm];
    ctx.strokeStyle = colour("--x");
    ctx.lineWidth = 1.5;
    ctx.beginPath();
    const each = Math.max(Math.floor(x.length / 4000), 1);
    let open = false;
    for (let i = 0; i < x.length; i += each) {
      if (Number.isNaN(x[i])) { open = false; continue; }
      if (open) ctx.lineTo(...at(i)); else ctx.moveTo(...at(i));
      open = true;
    }
    ctx.stroke();
    const last = x.length - 1;
    ctx.fillStyle = colour("--y");
    if (!Number.isNaN(x[last])) { ctx.beginPath(); ctx.arc(...at(last), 5, 0, 7); ctx.fill(); }
    this.scale_bar(ctx, mm, width, height);
  }

  scale_bar(ctx, mm, width, height) {
    const most = (width / 3) * mm, ten = 10 ** Math.floor(Math.log10(most));
    const bar = [5, 2, 1].map((n) => n * ten).find((n) => n <= most), end = 12 + bar / mm;
    ctx.strokeStyle = ctx.fillStyle = colour("--ink");
    ctx.lineWidth = 2;
    ctx.beginPath();
    ctx.moveTo(12, height - 14); ctx.lineTo(12, height - 6); ctx.moveTo(12, height - 10);
    ctx.lineTo(end, height - 10); ctx.moveTo(end, height - 14); ctx.lineTo(end, height - 6);
    ctx.stroke();
    ctx.font = "13px system-ui, sans-serif";
    ctx.fillText(bar < 0.1 ? `${+(bar * 1000).toPrecision(1)} µm` : `${+bar.toPrecision(1)} mm`, end + 8, height - 5);
  }
}
