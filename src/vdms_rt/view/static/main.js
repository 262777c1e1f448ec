// The page: what is chosen, what is connected, and which view is open.

import { byId, bytes, choices, define, plain } from "/static/format.js";
import { hasToken, Link, setToken } from "/static/link.js";
import { Look } from "/static/look.js";
import { Run } from "/static/run.js";
import { SetUp } from "/static/setup.js";
import { Store } from "/static/store.js";

const STREAM = 1;
const TOAST_MS = 6000;
const WAITING = ["starting", "streaming", "looking for the marker", "waiting for still", "taking the reference", "checking the stored set-up", "stopping"];
const HINTS = {
  "looking for the marker": "Show the camera the whole marker, lit and sharp; Set up has the live picture.",
  "waiting for still": "Let the marker rest: the reference is taken as soon as nothing moves.",
  "set-up stale": "Camera or marker was moved since the reference was taken: let it rest and take a new one in Set up.",
  "no signal": "The grabber gives no camera's picture: check the camera's power and the cable.",
  "no device": "There is no grabber or camera: plug it in.",
  "stalled": "The grabber gives no frames; the station is trying to wake it.",
  "lost": "The grabber is gone: plug it in again.",
  "gone": "The station has stopped or cannot be reached; the page goes on trying.",
};

const page = {
  station: "", marker: "", access: "look", summary: {}, connected: false, skipped: "",
  get alive() { return Boolean(page.summary[page.station]?.alive); },
  get may_control() { return page.access === "control" || (page.access === "token" && hasToken()); },
  analogue: (width_px, height_px) => [704, 720].includes(width_px) && [480, 576].includes(height_px),
  tell(answer) {
    if (answer.code === "not-allowed" && page.access === "token") { setToken(""); show_access(); open_token(answer.text); return; }
    toast(answer.text, !answer.done);
  },
};
const store = new Store(), look = new Look(store), set_up = new SetUp(page), run = new Run(page);

const link = new Link({
  connected(is) { page.connected = is; show_station(); },
  hello({ access, addresses }) { page.access = access; byId("addresses").textContent = addresses.join(", "); show_access(); },
  summary({ stations, events }) { page.summary = stations; show_choices(); show_station(); run.events(events); },
  stretch({ stream, session, goes_on }) {
    if (stream !== STREAM) return;
    if (!goes_on) { store.clear(); look.cleared(); }
    store.session = session;
  },
  skipped({ stream, first_seq, last_seq }) {
    if (stream !== STREAM) return;
    page.skipped = `${last_seq - first_seq + 1} samples, seq ${first_seq} to ${last_seq}`;
    toast(`This browser was away for too long and skipped ${page.skipped}; the recording has them.`, true);
  },
  samples(samples) { if (samples.stream === STREAM) { store.add(samples); look.added(); } },
});

function show_choices() {
  const stations = Object.keys(page.summary);
  choices(byId("station"), stations);
  const markers = Object.keys(page.summary[byId("station").value]?.markers ?? {});
  choices(byId("marker"), markers);
  // Until a person chooses one it is the first of those that move.
  if (markers.includes(chosen_marker)) byId("marker").value = chosen_marker; else if (markers.length) byId("marker").value = markers[0];
  const station = byId("station").value, marker = byId("marker").value;
  if (station === page.station && marker === page.marker) return;
  Object.assign(page, { station, marker, skipped: "" });
  store.clear();
  look.cleared();
  set_up.edited = null;
  if (marker) {
    link.show(STREAM, () => ({ station, marker, session: store.session, last_seq: store.last_seq ?? 0 }));
  }
  set_up.look();
  run.refresh();
}

function show_station() {
  const station = page.summary[page.station], marker = station?.markers[page.marker];
  const pill = byId("state"), state = page.connected ? (station?.state ?? "no station") : "no server";
  pill.textContent = state;
  pill.dataset.state = state === "measuring" ? "measuring" : WAITING.includes(state) || !station ? "waiting" : "bad";
  const nobody = page.connected && !station;
  byId("nobody").hidden = !nobody;
  show_tab(open_tab, nobody);
  const health = station?.health;
  const [text, severity] = banner(state, health, marker);
  byId("banner").hidden = !text;
  if (byId("banner").textContent !== text) byId("banner").textContent = text;
  byId("banner").dataset.severity = severity;
  set_up.standing(station);
  if (!health) { define(byId("facts"), []); return; }
  const lost = health.missed + health.overwritten;
  define(byId("facts"), [
    ["standing", marker?.standing ?? "–", marker?.valid ? "" : "warn"],
    ["rate", `${plain(health.frame_rate_hz, 2)} frames/s, ${plain(store.rate_hz(), 2)} samples/s`],
    ["lost", `${lost} frames, ${health.invalid} invalid samples`, lost ? "warn" : ""],
    ["this page", page.skipped ? `skipped ${page.skipped}` : marker?.on_the_way ? `${marker.on_the_way} samples lost on the way` : "has every sample", page.skipped || marker?.on_the_way ? "warn" : ""],
    ["recording", health.record_trouble || health.recording.split("/").pop().replace(/\.mcap(\.part)?$/, "") || "no", health.record_trouble ? "bad" : ""],
    ...(health.pixels_left_out ? [["left out", `the pixels of ${health.pixels_left_out} frames`, "warn"]] : []),
    ["disk left", bytes(health.disk_free_bytes), health.disk_free_bytes < 5e9 ? "warn" : ""],
    ["clock", `UTC ${health.utc_state}, ± ${plain(health.clock_sigma_us, 0)} µs`],
    ["age", `${plain(health.sample_age_ms, 0)} ms from light to number`],
    ["device", health.device],
  ]);
}

function banner(state, health, marker) {
  if (!page.connected) return ["The page's server does not answer; trying again. Is vdms-rt view still running?", 2];
  if (health?.record_trouble && page.alive) return [`Not recording: ${health.record_trouble}`, 2];
  if (HINTS[state]) return [HINTS[state], WAITING.includes(state) ? 1 : 2];
  if (state === "measuring" && marker && !marker.valid) return [`${page.marker}: ${marker.standing}`, 1];
  return ["", 0];
}

function show_access() {
  for (const button of document.querySelectorAll(".control")) {
    button.disabled = !page.may_control;
    button.title = page.may_control ? "" : page.access === "token" ? "Unlock control first" : "From another computer this page is for looking only";
  }
  byId("token-button").hidden = page.access !== "token" || hasToken();
}

function open_token(fault = "") {
  byId("token-fault").textContent = fault;
  byId("token-dialog").returnValue = "";
  if (!byId("token-dialog").open) byId("token-dialog").showModal();
}

let chosen_marker = "", toast_timer;
function toast(text, bad) {
  const box = byId("toast");
  box.textContent = text;
  box.classList.toggle("bad", bad);
  box.hidden = false;
  clearTimeout(toast_timer);
  toast_timer = setTimeout(() => { box.hidden = true; }, TOAST_MS);
}

const TABS = ["look", "setup", "run"];
let open_tab = TABS.includes(location.hash.slice(1)) ? location.hash.slice(1) : "look";

function show_tab(name, nobody = !byId("nobody").hidden) {
  const before = open_tab, seen = !byId(name).hidden;
  open_tab = name;
  for (const tab of TABS) {
    byId(tab).hidden = nobody || tab !== name;
    byId(`tab-${tab}`).setAttribute("aria-selected", tab === name);
    byId(`tab-${tab}`).tabIndex = tab === name ? 0 : -1;
  }
  if (before === name && seen) return;
  look.dirty = true;
  set_up.look();
  run.refresh();
}

for (const tab of TABS) {
  byId(`tab-${tab}`).onclick = () => { history.replaceState(null, "", `#${tab}`); show_tab(tab); };
  byId(`tab-${tab}`).onkeydown = (event) => {
    const by = { ArrowLeft: 2, ArrowRight: 1 }[event.key];
    if (!by) return;
    event.stopPropagation();
    const next = byId(`tab-${TABS[(TABS.indexOf(tab) + by) % TABS.length]}`);
    next.click();
    next.focus();
  };
}
byId("station").onchange = () => { show_choices(); show_station(); };
byId("marker").onchange = () => { chosen_marker = byId("marker").value; show_choices(); show_station(); };
byId("token-button").onclick = () => open_token();
byId("token-cancel").onclick = () => byId("token-dialog").close();
byId("token-dialog").addEventListener("close", () => {
  if (byId("token-dialog").returnValue !== "ok") return;
  setToken(byId("token").value.trim());
  byId("token").value = "";
  show_access();
});
byId("theme").onclick = () => {
  const root = document.documentElement;
  root.dataset.theme = root.dataset.theme === "dark" ? "light" : "dark";
  localStorage.setItem("theme", root.dataset.theme);
  show_theme();
};
function show_theme() {
  byId("theme").textContent = document.documentElement.dataset.theme === "dark" ? "Light" : "Dark";
  look.repaint();
}
addEventListener("keydown", (event) => {
  if (open_tab !== "look" || event.ctrlKey || event.metaKey || event.altKey) return;
  const typing = event.target.closest("input, select, textarea, dialog") || (event.key === " " && event.target.closest("button"));
  if (!typing && look.key(event)) event.preventDefault();
});
document.addEventListener("visibilitychange", () => { if (!document.hidden) { set_up.look(); run.refresh(); } });

// The address that `vdms-rt view` prints carries the token where no server sees it.
const carried = /^#token=(.+)$/.exec(location.hash);
if (carried) {
  setToken(decodeURIComponent(carried[1]));
  history.replaceState(null, "", "/");
}
show_theme();
show_tab(open_tab);
show_station();
