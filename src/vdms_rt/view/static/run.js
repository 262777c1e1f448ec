// Run: named recordings, notes, and what happened.

import { ask } from "/static/link.js";
import { byId, bytes, clock, date, duration, element } from "/static/format.js";

const LIST_MS = 3000;
const EVENTS_SHOWN = 100;
const REPEATED = ["frames-missed", "frames-overwritten", "missed"];

export class Run {
  /** `page` has station, may_control, tell(answer). */
  constructor(page) {
    Object.assign(this, { page, name: "", since_ms: 0 });
    byId("run-form").addEventListener("submit", (event) => { event.preventDefault(); this.start(); });
    byId("stop").onclick = () => this.command({ action: "STOP" });
    byId("mark-form").addEventListener("submit", (event) => { event.preventDefault(); this.mark(); });
    setInterval(() => this.refresh(), LIST_MS);
    setInterval(() => this.show_name(), 1000);
  }

  async command(fields) {
    const answer = await ask(this.page.station, "record", fields);
    this.page.tell(answer);
    await this.refresh();
    return answer.done;
  }

  start() { return this.command({ action: "START", text: byId("run-name").value }); }

  async mark() { if (await this.command({ action: "MARK", text: byId("note").value })) byId("note").value = ""; }

  /** Ask whether a run goes on, and for the list where it is seen. */
  async refresh() {
    const station = this.page.station;
    if (!station || !this.page.alive || document.hidden) return;
    const status = await ask(station, "status");
    if (station !== this.page.station) return;
    const name = status.done ? status.status.run : "";
    if (name !== this.name) { this.name = name; this.since_ms = name ? performance.now() : 0; }
    this.show_name();
    if (byId("run").hidden) return;
    const list = await ask(station, "recordings");
    if (station === this.page.station) this.show_list(list);
  }

  show_name() {
    const pill = byId("run-pill");
    byId("start").hidden = Boolean(this.name);
    byId("stop").hidden = pill.hidden = !this.name;
    byId("run-name").disabled = Boolean(this.name);
    pill.textContent = `● run ${this.name}`;
    const file = this.open_run;
    byId("run-standing").textContent = this.name ? `being recorded${file ? `, ${bytes(Number(file.size_bytes))}` : ""}` : "";
  }

  show_list(answer) {
    const body = byId("recordings");
    if (!answer.done) {
      body.replaceChildren(element("tr", {}, element("td", { colSpan: 5, className: "name", textContent: answer.text })));
      return;
    }
    const { recordings, directory, disk_free_bytes } = answer.recordings;
    this.open_run = recordings.find((r) => r.open && r.run === this.name);
    byId("directory").textContent = `${directory}, ${bytes(Number(disk_free_bytes))} free`;
    if (!recordings.length) {
      body.replaceChildren(element("tr", {}, element("td", { colSpan: 5, textContent: "No recording yet." })));
      return;
    }
    body.replaceChildren(...recordings.slice(0, 200).map((r) => {
      const begin_s = Number(r.begin_utc_ns) / 1e9;
      const cells = [`${date(begin_s)} ${clock(begin_s)}`, r.run || "–", r.open && !r.length_s ? "being written" : duration(r.length_s), bytes(Number(r.size_bytes)), r.name];
      const row = element("tr", {}, ...cells.map((text) => element("td", { textContent: text })));
      row.children[2].className = row.children[3].className = "number";
      row.children[4].className = "name";
      return row;
    }));
  }

  events(news) {
    const list = byId("events");
    for (const event of news) {
      const kind = `${event.station} ${event.code}`, newest = list.firstChild;
      const item = element("li", { className: `s${event.severity}` }, element("time", { textContent: clock(event.utc_s) }), `${event.station ? `${event.station}: ` : ""}${event.text}`);
      item.dataset.kind = kind;
      item.dataset.times = 1;
      // What happens many times in a row is one line.
      if (REPEATED.includes(event.code) && newest?.dataset.kind === kind) {
        item.dataset.times = Number(newest.dataset.times) + 1;
        item.append(element("b", { textContent: `× ${item.dataset.times}` }));
        newest.remove();
      }
      list.prepend(item);
    }
    while (list.children.length > EVENTS_SHOWN) list.lastChild.remove();
  }
}
