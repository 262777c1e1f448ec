// Numbers, times and elements as a person reads them.

export const byId = (id) => document.getElementById(id);

/** A signed number of fixed width, so that it does not dance; a dash for none. */
export function signed(value, digits = 3) {
  if (value === null || !Number.isFinite(value)) return "–";
  const text = Math.abs(value).toFixed(digits);
  return (value < 0 && Number(text) ? "−" : "+") + text;
}

export const plain = (value, digits) => (Number.isFinite(value) ? value.toFixed(digits) : "–");

/** A length in the unit that suits it. */
export function length(mm) {
  if (!Number.isFinite(mm)) return "–";
  if (Math.abs(mm) < 0.1) return `${(mm * 1000).toFixed(1)} µm`;
  return `${mm.toFixed(Math.abs(mm) < 10 ? 3 : 2)} mm`;
}

export function clock(utc_s, digits = 0) {
  const at = new Date(utc_s * 1000);
  const text = [at.getHours(), at.getMinutes(), at.getSeconds()].map((n) => String(n).padStart(2, "0")).join(":");
  return digits ? `${text}.${String(Math.floor((utc_s % 1) * 10 ** digits)).padStart(digits, "0")}` : text;
}

export function date(utc_s) {
  const at = new Date(utc_s * 1000);
  return `${at.getFullYear()}-${String(at.getMonth() + 1).padStart(2, "0")}-${String(at.getDate()).padStart(2, "0")}`;
}

export function duration(s) {
  const all = Math.floor(s), pad = (n) => String(n).padStart(2, "0");
  const h = Math.floor(all / 3600), m = Math.floor(all / 60) % 60;
  return h ? `${h}:${pad(m)}:${pad(all % 60)} h` : `${m}:${pad(all % 60)} min`;
}

export function bytes(n) {
  if (n >= 1e12) return `${(n / 1e12).toFixed(2)} TB`;
  if (n >= 1e9) return `${(n / 1e9).toFixed(n < 1e10 ? 2 : 1)} GB`;
  return `${(n / 1e6).toFixed(1)} MB`;
}

/** Make an element; text is never read as HTML. */
export function element(name, properties = {}, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

/** Fill a definition list with [name, text, class]; elements that stay keep their identity. */
export function define(list, rows) {
  while (list.children.length > rows.length * 2) list.lastChild.remove();
  rows.forEach(([name, text, kind], i) => {
    if (!list.children[2 * i]) list.append(element("dt"), element("dd"));
    const [term, told] = [list.children[2 * i], list.children[2 * i + 1]];
    if (term.textContent !== name) term.textContent = name;
    if (told.textContent !== text) told.textContent = text;
    told.className = kind ?? "";
  });
}

/** Set the choices of a select, keeping the chosen one where it can be. */
export function choices(select, names) {
  const now = [...select.options].map((option) => option.value);
  if (now.length === names.length && now.every((name, i) => name === names[i])) return;
  const chosen = select.value;
  select.replaceChildren(...names.map((name) => element("option", { value: name, textContent: name })));
  if (names.includes(chosen)) select.value = chosen;
}

export const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
