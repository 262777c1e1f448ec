// Set up: the live picture, the regions in it, and what to do about what the camera sees.

import { ask } from "/static/link.js";
import { byId, define, element, length, plain } from "/static/format.js";

const SVG = "http://www.w3.org/2000/svg";
const PICTURE_MS = 250;
const RETRY_MS = 1500;
const LEAST_PX = 8;

export class SetUp {
  /** `page` has station, marker, may_control, tell(answer), summary. */
  constructor(page) {
    Object.assign(this, { page, preview: null, edited: null, asking: false });
    byId("find").onclick = () => this.command("find");
    byId("apply").onclick = () => this.apply();
    byId("discard").onclick = () => this.discard();
    byId("live-picture").onchange = () => this.look();
    this.form("reference-form", () => this.command("reference", { stills: Number(byId("stills").value) || 0 }));
    this.form("zero-form", () => this.command("zero", { marker: page.marker }));
    this.form("size-form", () => this.command("marker", { marker: page.marker, spacing_mm: Number(byId("spacing").value), diameter_mm: Number(byId("diameter").value) }));
    this.form("axis-form", () => this.command("axis", { marker: page.marker, axis_deg: Number(byId("axis").value) }));
    this.form("order-form", () => this.command("field-order", { order: byId("order").value }));
    this.form("stroke-form", () => this.stroke());
    byId("save-set-up").onclick = () => this.save((status) => [status.set_up.json, "set-up.json", "application/json"]);
    byId("save-report").onclick = () => this.save((status) => [`${status.set_up.report}\n`, "set-up.txt", "text/plain"]);
    byId("save-picture").onclick = () => this.preview && download(byId("picture").src, `${page.station}.jpg`);
    new ResizeObserver(() => this.place()).observe(byId("preview"));
  }

  form(id, act) {
    byId(id).addEventListener("submit", (event) => { event.preventDefault(); act(); });
  }

  get open() { return !byId("setup").hidden && !document.hidden; }

  async command(verb, fields = {}) {
    const answer = await ask(this.page.station, verb, fields);
    this.page.tell(answer);
    return answer.done;
  }

  async stroke() {
    const answer = await ask(this.page.station, "stroke", { marker: this.page.marker, stroke_mm: Number(byId("stroke").value) });
    if (answer.done && answer.stroke) {
      const s = answer.stroke;
      answer.text = `${plain(s.length_mm, 4)} mm along ${plain(s.axis_deg, 2)} deg; true over measured ${plain(s.scale, 5)}`;
    }
    this.page.tell(answer);
  }

  async save(part) {
    const answer = await ask(this.page.station, "status");
    if (!answer.done) return this.page.tell(answer);
    if (!answer.status.set_up) return this.page.tell({ done: false, text: "There is no set-up yet: take a reference first." });
    const [text, name, type] = part(answer.status);
    const url = URL.createObjectURL(new Blob([text], { type }));
    download(url, `${this.page.station}-${name}`);
    URL.revokeObjectURL(url);
  }

  /** Begin to show pictures, as long as this view is open. */
  look() {
    clearTimeout(this.timer);
    if (!this.asking) this.next();
  }

  async next() {
    if (!this.open || !this.page.station) return;
    this.asking = true;
    const station = this.page.station, answer = await ask(station, "preview");
    this.asking = false;
    if (station === this.page.station) this.show(answer);
    if (!this.open || !byId("live-picture").checked) return;
    this.timer = setTimeout(() => this.next(), answer.done ? PICTURE_MS : RETRY_MS);
  }

  show(answer) {
    const picture = byId("picture");
    byId("no-picture").textContent = answer.done ? "" : answer.text;
    byId("no-picture").hidden = picture.hidden = false;
    picture.hidden = !answer.done;
    byId("regions").style.display = answer.done ? "" : "none";
    if (!answer.done) { this.preview = null; this.show_aim(null); return; }
    this.preview = answer.preview;
    picture.src = `data:image/jpeg;base64,${answer.preview.jpeg}`;
    this.place();
    if (!this.edited) this.draw_regions();
    this.show_aim(answer.preview.markers.find((m) => m.marker === this.page.marker) ?? answer.preview.markers[0]);
  }

  /** Lay picture and regions over each other, as large as fits. */
  place() {
    if (!this.preview) return;
    const { clientWidth, clientHeight } = byId("preview"), { width_px, height_px } = this.preview;
    // An analogue frame is shown 4:3, whatever its number of columns.
    const aspect = this.page.analogue(width_px, height_px) ? 4 / 3 : width_px / height_px;
    const width = Math.min(clientWidth, clientHeight * aspect), height = width / aspect;
    for (const part of [byId("picture"), byId("regions")]) {
      Object.assign(part.style, { width: `${width}px`, height: `${height}px`, left: `${(clientWidth - width) / 2}px`, top: `${(clientHeight - height) / 2}px` });
    }
    const svg = byId("regions");
    svg.setAttribute("viewBox", `0 0 ${width_px} ${height_px}`);
    svg.setAttribute("preserveAspectRatio", "none");
  }

  regions() {
    return this.edited ?? (this.preview?.markers ?? []).flatMap((m, n) => m.regions.map((r, i) => ({ ...r, marker: m.marker, n, i })));
  }

  draw_regions() {
    const svg = byId("regions"), all = this.regions();
    while (svg.children.length > all.length) svg.lastChild.remove();
    all.forEach((region, at) => {
      if (!svg.children[at]) svg.append(this.region_group(at));
      const group = svg.children[at], [rect, label, ...handles] = group.children;
      const { x_px: x, y_px: y, width_px: w, height_px: h } = region;
      group.setAttribute("class", `${region.n ? "m1" : ""} ${region.changed ? "changed" : ""}`);
      group.setAttribute("aria-label", `Region ${region.i + 1} of ${region.marker}: ${w} by ${h} pixels at ${x}, ${y}`);
      set(rect, { x: x - 0.5, y: y - 0.5, width: w, height: h });
      set(label, { x: x + 4, y: y + 17 });
      label.textContent = `${region.marker} ${region.i + 1}`;
      [[x, y], [x + w, y], [x, y + h], [x + w, y + h]].forEach(([cx, cy], k) => set(handles[k], { cx: cx - 0.5, cy: cy - 0.5 }));
    });
    byId("apply").hidden = byId("discard").hidden = !this.edited;
  }

  region_group(at) {
    const group = document.createElementNS(SVG, "g"), make = (name, attributes) => set(document.createElementNS(SVG, name), attributes);
    set(group, { tabindex: 0, role: "button", "aria-roledescription": "region" });
    const rect = make("rect", { class: "region" });
    group.append(rect, make("text", { "font-size": 15 }));
    this.drag(rect, at, { left: 1, top: 1, right: 1, bottom: 1 });
    [[1, 0, 1, 0], [0, 1, 1, 0], [1, 0, 0, 1], [0, 1, 0, 1]].forEach(([left, right, top, bottom], k) => {
      const handle = make("circle", { r: 6, class: `handle ${k === 1 || k === 2 ? "b" : ""}` });
      this.drag(handle, at, { left, right, top, bottom });
      group.append(handle);
    });
    group.addEventListener("keydown", (event) => this.key(event, at));
    return group;
  }

  drag(part, at, edges) {
    part.style.touchAction = "none";
    part.addEventListener("pointerdown", (event) => {
      if (!this.page.may_control || !this.regions()[at]) return;
      event.preventDefault();
      part.parentNode.focus();
      part.setPointerCapture(event.pointerId);
      const before = { ...this.regions()[at] }, from = this.pixels(event);
      part.onpointermove = (moved) => {
        const to = this.pixels(moved);
        this.change(at, before, edges, Math.round(to.x - from.x), Math.round(to.y - from.y));
      };
      part.onpointerup = part.onpointercancel = () => { part.onpointermove = null; };
    });
  }

  key(event, at) {
    const [dx, dy] = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key] ?? [];
    if (event.key === "Escape" && this.edited) return this.discard();
    if (event.key === "Enter" && this.edited) return this.apply();
    if (dx === undefined || !this.page.may_control) return;
    event.preventDefault();
    event.stopPropagation();
    const edges = event.shiftKey ? { left: 0, top: 0, right: 1, bottom: 1 } : { left: 1, top: 1, right: 1, bottom: 1 };
    const step = event.ctrlKey ? 10 : 1;
    this.change(at, this.regions()[at], edges, dx * step, dy * step);
  }

  pixels(event) {
    const box = byId("regions").getBoundingClientRect();
    return { x: ((event.clientX - box.left) / box.width) * this.preview.width_px, y: ((event.clientY - box.top) / box.height) * this.preview.height_px };
  }

  /** Move the chosen edges by so many pixels; the region stays in the picture and not too small. */
  change(at, before, edges, dx, dy) {
    if (!dx && !dy) return;
    this.edited ??= this.regions().map((r) => ({ ...r }));
    const span = (low, size, low_moves, high_moves, by, most) => {
      if (low_moves && high_moves) return [clamp(low + by, 0, most - size), size];
      if (low_moves) { const to = clamp(low + by, 0, low + size - LEAST_PX); return [to, low + size - to]; }
      return [low, clamp(size + (high_moves ? by : 0), LEAST_PX, most - low)];
    };
    const region = this.edited[at];
    [region.x_px, region.width_px] = span(before.x_px, before.width_px, edges.left, edges.right, dx, this.preview.width_px);
    [region.y_px, region.height_px] = span(before.y_px, before.height_px, edges.top, edges.bottom, dy, this.preview.height_px);
    region.changed = true;
    this.draw_regions();
  }

  async apply() {
    const markers = new Set(this.edited.filter((r) => r.changed).map((r) => r.marker));
    for (const marker of markers) {
      const regions = this.edited.filter((r) => r.marker === marker).map(({ x_px, y_px, width_px, height_px }) => ({ x_px, y_px, width_px, height_px }));
      if (!(await this.command("regions", { marker, regions }))) return;
    }
    this.discard();
  }

  discard() { this.edited = null; this.draw_regions(); }

  show_aim(seen) {
    byId("aim-marker").textContent = seen?.marker ?? "the marker";
    const aim = seen?.aim, advice = byId("advice");
    const told = aim ? (aim.advice.length ? aim.advice : ["all is well"]) : [seen ? "the marker is not seen whole: bring it into the picture, lit and sharp" : "no picture, so nothing is known yet"];
    if ([...advice.children].map((li) => li.textContent).join() !== told.join()) {
      advice.replaceChildren(...told.map((text) => element("li", { textContent: text, className: aim && !aim.advice.length ? "fine" : "" })));
    }
    define(byId("aim"), aim ? aim_rows(aim) : []);
  }

  /** The summary has news of the station. */
  standing(station) {
    byId("set-up-standing").textContent = station ? `The station is ${station.state}. It keeps each new reference by itself where its setup.store says so.` : "";
  }
}

function aim_rows(aim) {
  const side = aim.side_known ? (aim.turn_deg > 0 ? "right side farther" : "left side farther") : "one side farther";
  const tilt = aim.angle_deg <= aim.angle_error_deg ? `straight on, within ${plain(aim.angle_deg + aim.angle_error_deg, 0)} deg` : `${plain(aim.angle_deg, 1)} deg, ${side}`;
  return [
    ["expected", `σ ${length(aim.sigma_x_mm)} in x, ${length(aim.sigma_y_mm)} in y`],
    ["focus", `${aim.focus}: edges ${plain(aim.edge_x_px, 1)} × ${plain(aim.edge_y_px, 1)} px`, aim.focus === "sharp" ? "" : "warn"],
    ["exposure", `black ${plain(aim.black_grey, 0)}, white ${plain(aim.white_grey, 0)}, ${plain(aim.saturated_percent, 1)} % saturated`, aim.saturated_percent > 0.5 ? "warn" : ""],
    ["tilt", tilt],
    ["roll", Math.abs(aim.roll_deg) < 0.05 ? "none" : `${plain(Math.abs(aim.roll_deg), 1)} deg ${aim.roll_deg > 0 ? "counter-clockwise" : "clockwise"}`],
    ["scale", `${plain(aim.scale_x_px_per_mm, 3)} px/mm across, ${plain(aim.scale_y_px_per_mm, 3)} up`],
    ["noise", `${plain(aim.noise_grey, 1)} grey levels`],
    ["room", `${plain(aim.left_mm, 0)} mm left, ${plain(aim.right_mm, 0)} right, ${plain(aim.up_mm, 0)} up, ${plain(aim.down_mm, 0)} down`],
  ];
}

function set(part, attributes) {
  for (const [name, value] of Object.entries(attributes)) part.setAttribute(name, value);
  return part;
}

const clamp = (value, low, high) => Math.min(Math.max(value, low), Math.max(high, low));

function download(url, name) {
  element("a", { href: url, download: name }).click();
}
