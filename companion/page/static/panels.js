// Everything in words and numbers. Text is written only where it changed; state changes are announced, numbers are not.

const SHAPES = { WAITING: "○", READY: "●", ACTIVE: "▶", HOLD: "■", OVERRIDDEN: "◆", FAULT: "✖" };
const OLD_S = 1; // what was not heard for this long is marked
const PARTS = ["radii", "cushion", "sigma", "delay"];
const MOST_OBSTACLES = 6;

const element = (id) => document.getElementById(id);
const write = (node, text) => { if (node.textContent !== text) node.textContent = text; };
const numbers = (values, digits = 2) => values.map((v) => v.toFixed(digits)).join(", ");
const age = (seconds) => (seconds === null ? "never" : seconds < 10 ? `${Math.max(0, seconds).toFixed(1)} s ago` : `${seconds.toFixed(0)} s ago`);

function make(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  Object.entries(attributes).forEach(([name, value]) => node.setAttribute(name, value));
  node.append(...children);
  return node;
}

export class Panels {
  constructor() {
    this.told = "";
  }

  show(frame) {
    write(element("vehicle"), frame.mode === "monitor" ? `${frame.vehicle} (monitor)` : frame.vehicle);
    this.showState(frame);
    this.showFlight(frame);
    this.showLatency(frame);
    this.showLinks(frame);
    this.showObstacles(frame);
  }

  showState({ vehicle, status, tick }) {
    const state = status ? status.state : "NONE", reason = status ? status.reason : "";
    element("state").dataset.state = state;
    write(element("state-shape"), SHAPES[state] || "○");
    write(element("state-name"), status ? state : "no state yet");
    write(element("reason"), reason);
    document.title = `${state === "NONE" ? "" : `${state} · `}${vehicle}`;
    const verdict = element("verdict"), said = tick ? tick.verdict : "";
    verdict.hidden = !said;
    write(verdict, said && `verdict: ${said}${tick.detour ? ", detour" : ""}${tick.sent ? "" : ", nothing sent"}`);
    verdict.dataset.level = { relaxed: "bad", braking: "bad", adjusted: "warn" }[said] || "";
    this.showWarnings(status ? status.warnings : []);
    const words = status ? `State ${state}${reason ? `: ${reason}` : ""}.${status.warnings.map((text) => ` Warning: ${text}.`).join("")}` : "";
    if (words !== this.told) write(element("announce"), (this.told = words));
  }

  showWarnings(warnings) {
    element("no-warnings").hidden = warnings.length > 0;
    const list = element("warnings");
    if (list.dataset.shown === warnings.join("\n")) return;
    list.dataset.shown = warnings.join("\n");
    list.replaceChildren(...warnings.map((text) => make("li", {}, text)));
  }

  showFlight({ status, tick, mode_name, route, period_ms }) {
    const target = route.length ? `${numbers(route[0])}${route.length > 1 ? ` (+${route.length - 1})` : ""}` : "hold where engaged";
    const heading = tick ? (((90 - (tick.yaw * 180) / Math.PI) % 360) + 360) % 360 : 0;
    this.list("flight", [
      ["vehicle mode", mode_name],
      ["engaged", status ? (status.engaged ? "yes" : "no") : "–"],
      ["armed, airborne", status ? `${status.armed ? "yes" : "no"}, ${status.airborne ? "yes" : "no"}` : "–"],
      ["position [m]", tick ? numbers(tick.p) : "–"],
      ["velocity [m/s]", tick ? numbers(tick.v) : "–"],
      ["heading", tick ? `${heading.toFixed(0)}°` : "–"],
      ["target [m]", target],
      ["tightest row", (tick && tick.tightest) || "none"],
      ["its slack", tick && tick.slack !== null ? `${tick.slack.toFixed(2)} m/s²` : "–"],
      ["profile", status ? `${status.profile}, ${Math.round(1000 / period_ms)} Hz` : "–"],
    ]);
  }

  showLatency({ status, period_ms }) {
    const ms = status ? status.tick_ms : {}, counts = status ? status.counts : {};
    const show = (name) => (ms[name] === undefined ? "–" : `${ms[name].toFixed(2)} ms`);
    this.list("latency", [
      ...["p50", "p99", "max"].map((name) => [name, show(name)]),
      ["period", `${period_ms.toFixed(0)} ms`],
      ["deadline misses", String(counts.deadline_misses ?? "–")],
    ]);
    this.list("counts", Object.entries(counts).map(([name, count]) => [name, String(count)]));
  }

  showLinks({ links, sources }) {
    const rows = [...links.map((link) => [link, "link"]), ...sources.map((source) => [source, "source"])];
    const body = element("links");
    while (body.rows.length > rows.length) body.deleteRow(-1);
    rows.forEach(([item, kind], i) => {
      const row = body.rows[i] || body.insertRow();
      while (row.cells.length < 2) row.insertCell();
      write(row.cells[0], `${kind} ${item.name}${item.note ? ` (${item.note})` : ""}`);
      write(row.cells[1], age(item.age));
      row.cells[1].className = item.age === null || item.age > OLD_S ? "bad" : "";
    });
  }

  showObstacles({ tick }) {
    const tracks = tick ? tick.tracks.slice(0, MOST_OBSTACLES) : [], count = tick ? tick.tracks.length + tick.hidden : 0;
    element("no-obstacles").hidden = count > 0;
    write(element("tally"), tick ? `${count} obstacle${count === 1 ? "" : "s"}` : "");
    const list = element("obstacles"), binding = bound(tick);
    while (list.children.length > tracks.length) list.lastElementChild.remove();
    const room = Math.max(1, ...tracks.map((track) => distance(track.keep_out)));
    tracks.forEach((track, i) => {
      const item = list.children[i] || list.appendChild(obstacleItem());
      showObstacle(item, track, track.id === binding, room);
    });
  }

  list(id, pairs) {
    const list = element(id);
    while (list.children.length > 2 * pairs.length) list.lastElementChild.remove();
    pairs.forEach(([name, value], i) => {
      if (list.children.length < 2 * i + 2) list.append(make("dt"), make("dd"));
      write(list.children[2 * i], name);
      write(list.children[2 * i + 1], value);
    });
  }
}

// The obstacle that changed the answer: that of the tightest row, where the reference did not pass unchanged.
export function bound(tick) {
  return tick && tick.tightest && tick.verdict !== "nominal" ? tick.tightest.split(",")[0] : "";
}

// D [m], the sum of its parts.
function distance(keep) {
  return keep ? PARTS.reduce((sum, part) => sum + keep[part], 0) : 0;
}

function obstacleItem() {
  const bar = make("div", { class: "bar", "aria-hidden": "true" }, ...PARTS.map((part) => make("i", { class: part })));
  const parts = make("div", { class: "parts" }, ...PARTS.map((part) => make("span", { class: part }, make("b", { "aria-hidden": "true" }), make("span"))));
  return make("li", {}, make("div", { class: "name" }, make("span"), make("span")), bar, parts);
}

function showObstacle(item, track, binding, room) {
  const [name, bar, parts] = item.children, keep = track.keep_out;
  write(name.children[0], track.status === "confirmed" ? track.id : `${track.id} (${track.status})`);
  name.children[0].classList.toggle("binding", binding);
  write(name.children[1], `${track.clearance.toFixed(2)} m clear`);
  bar.hidden = parts.hidden = !keep;
  if (!keep) return;
  PARTS.forEach((part, i) => {
    bar.children[i].style.width = `${(100 * keep[part]) / room}%`;
    write(parts.children[i].lastElementChild, `${part} ${keep[part].toFixed(2)}`);
  });
  if (!parts.children[PARTS.length]) parts.append(make("span"));
  write(parts.children[PARTS.length], `= ${distance(keep).toFixed(2)} m, ${keep.step < 0 ? "braking" : `step ${keep.step}`}`);
}
