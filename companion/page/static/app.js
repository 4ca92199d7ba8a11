// Connects to the daemon, hands each message to whoever shows it, and says so when there is none.

import { Charts } from "./charts.js";
import { Controls } from "./controls.js";
import { Panels } from "./panels.js";
import { Views } from "./views.js";

const STALE_S = 1.5;
const RETRY_MS = [250, 500, 1000, 2000, 4000];
const element = (id) => document.getElementById(id);

const charts = new Charts(), panels = new Panels();
const views = new Views((x, y) => controls.picked(x, y));
const controls = new Controls(views);

let socket = null, failures = 0, heard = null, opened = performance.now(), frame = null, drawn = false, stale = false;

function connect() {
  socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/feed`);
  socket.onmessage = (event) => take(JSON.parse(event.data));
  socket.onclose = () => {
    setTimeout(connect, RETRY_MS[Math.min(failures, RETRY_MS.length - 1)]);
    failures += 1;
  };
}

function take(message) {
  failures = 0;
  heard = performance.now();
  frame = message;
  if (message.history) charts.restart(message.history);
  if (message.tick) charts.add(message.tick);
  watch();
  if (!drawn) {
    drawn = true; // once a screen refresh at most, and not at all in a hidden tab
    requestAnimationFrame(draw);
  }
}

function draw() {
  drawn = false;
  views.draw(frame, charts.trail());
  charts.draw(frame);
  controls.show(frame);
  panels.show(frame);
}

// "No data since N s": of the daemon, else of the vehicle.
function watch() {
  const silent = (performance.now() - (heard ?? opened)) / 1000, tickAge = frame && frame.tick_age !== null ? frame.tick_age + silent : null;
  let text = "";
  if (silent > STALE_S) text = heard === null ? `no connection to the daemon since ${silent.toFixed(0)} s` : `no data since ${silent.toFixed(0)} s, trying to connect`;
  else if (tickAge !== null && tickAge > STALE_S) text = `no vehicle data since ${tickAge.toFixed(0)} s`;
  element("stale").hidden = !text;
  element("stale-text").textContent = text;
  document.body.classList.toggle("stale", Boolean(text));
  const live = silent <= STALE_S;
  element("connection").textContent = live ? "live" : "no data";
  element("connection").dataset.level = live ? "" : "bad";
  if (Boolean(text) !== stale) {
    stale = Boolean(text);
    panels.told = "";
    element("announce").textContent = stale ? text : "data again";
  }
}

function theme(choice) {
  const dark = choice === "dark" || (choice === "auto" && matchMedia("(prefers-color-scheme: dark)").matches);
  document.documentElement.dataset.theme = dark ? "dark" : "light";
  document.documentElement.style.colorScheme = dark ? "dark" : "light";
  element("theme").value = choice;
  views.redraw();
  charts.draw();
}

// A browser that keeps nothing for us throws; the choice then lasts as long as the page.
let choice = "auto";
const chosen = () => { try { return localStorage.getItem("companion-theme") || choice; } catch { return choice; } };
element("theme").addEventListener("change", (event) => {
  choice = event.target.value;
  try { localStorage.setItem("companion-theme", choice); } catch { /* kept above */ }
  theme(choice);
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => theme(chosen()));
theme(chosen());
connect();
setInterval(watch, 250);
