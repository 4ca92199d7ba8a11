// The plan (x east, y north) and the side view (along the route, altitude): what is in sight, and by which camera.

import { bound } from "./panels.js";
import { Scene, colours } from "./scene.js";

const FIT_M = 14; // obstacles farther than this from the vehicle do not widen the view
const plane = {
  plan: { across: (p) => p[0], up: (p) => p[1], spread: (c) => [c[0], c[1], c[3]] },
  side: (origin, angle) => {
    const [x, y] = [Math.cos(angle), Math.sin(angle)];
    return {
      across: (p) => (p[0] - origin[0]) * x + (p[1] - origin[1]) * y,
      up: (p) => p[2],
      spread: (c) => [c[0] * x * x + 2 * c[1] * x * y + c[3] * y * y, c[2] * x + c[4] * y, c[5]],
    };
  },
};

export class Views {
  constructor(onPick) {
    this.plan = document.getElementById("plan");
    this.side = document.getElementById("side");
    this.cameras = { plan: { a: 0, b: 0, scale: 0 }, side: { a: 0, b: 0, scale: 0 } };
    this.auto = true;
    this.picked = null;
    this.axis = null; // of the side view: where it begins, its angle, for which target
    this.onPick = onPick;
    this.frame = null;
    this.trail = [];
    this.listen();
  }

  draw(frame, trail) {
    this.frame = frame;
    this.trail = trail;
    const paint = colours();
    this.drawPlan(frame, paint);
    this.drawSide(frame, paint);
  }

  redraw() {
    if (this.frame) this.draw(this.frame, this.trail);
  }

  drawPlan(frame, paint) {
    const shown = this.inSight(frame);
    if (this.auto) this.follow("plan", this.plan, shown.map((p) => [p[0], p[1]]), 1.2);
    const scene = new Scene(this.plan, this.cameras.plan, plane.plan, paint);
    scene.grid();
    const [low, high] = frame.arena;
    scene.box([low[0], low[1]], [high[0], high[1]]);
    this.drawScene(scene, frame, frame.tick ? frame.tick.yaw : 0);
    scene.axes(["east [m] →", "north [m] ↑"]);
    if (this.picked) scene.mark(this.picked);
    this.describe(frame);
  }

  drawSide(frame, paint) {
    this.turnAxis(frame);
    const seen = plane.side(this.axis.origin, this.axis.angle);
    const shown = this.inSight(frame).map((p) => [seen.across(p), seen.up(p)]);
    this.follow("side", this.side, [...shown, [shown[0]?.[0] ?? 0, 0], [shown[0]?.[0] ?? 0, 2.5]], 0.5);
    const scene = new Scene(this.side, this.cameras.side, seen, paint);
    scene.grid();
    const [low, high] = frame.arena;
    scene.context.strokeStyle = paint.arena;
    scene.context.lineWidth = 1.5;
    scene.context.setLineDash([9, 4, 2, 4]);
    for (const z of [low[2], high[2]]) scene.line([[0, scene.sy(z)], [scene.width, scene.sy(z)]]);
    scene.context.setLineDash([]);
    scene.text("floor", scene.width - 34, scene.sy(low[2]) + 12, paint.quiet, true);
    const yaw = frame.tick ? frame.tick.yaw - this.axis.angle : 0;
    this.drawScene(scene, frame, Math.cos(yaw) >= 0 ? 0 : Math.PI);
    scene.axes([`${this.axis.label} →`, "altitude [m] ↑"]);
  }

  drawScene(scene, frame, nose) {
    const tick = frame.tick;
    scene.trail(this.trail);
    if (!tick) return;
    scene.route(frame.route, tick.p);
    const binding = bound(tick);
    const farFirst = [...tick.tracks].reverse();
    for (const track of farFirst) if (track.id !== binding) scene.keepOut(track, false);
    for (const track of farFirst) if (track.id === binding) scene.keepOut(track, true);
    farFirst.forEach((track) => scene.obstacle(track));
    scene.vehicle(tick, frame.drone_radius, nose);
    tick.tracks.forEach((track) => scene.label(track));
    farFirst.forEach((track) => scene.outside(track, tick.p));
  }

  // World points that the automatic camera keeps in sight.
  inSight(frame) {
    const tick = frame.tick;
    if (!tick) return [frame.arena[0], frame.arena[1]];
    const near = tick.tracks.filter((track) => track.clearance < FIT_M).map((track) => track.p);
    const past = this.trail.length ? [this.trail[Math.max(0, this.trail.length - 200)], ...this.trail.slice(-200)] : [];
    return [tick.p, ...frame.route, ...near, ...past];
  }

  // Moves a camera towards one that shows all points with a border of so many metres.
  follow(name, canvas, points, border) {
    const camera = this.cameras[name], size = `${canvas.clientWidth}x${canvas.clientHeight}`;
    const firstTime = camera.scale === 0 || camera.size !== size;
    camera.size = size;
    const a = points.map((p) => p[0]), b = points.map((p) => p[1]);
    const [a0, a1, b0, b1] = [Math.min(...a) - border, Math.max(...a) + border, Math.min(...b) - border, Math.max(...b) + border];
    const width = Math.max(50, canvas.clientWidth), height = Math.max(50, canvas.clientHeight - 20);
    const wanted = { a: (a0 + a1) / 2, b: (b0 + b1) / 2, scale: Math.min(width / Math.max(4, a1 - a0), height / Math.max(2, b1 - b0), 160) };
    wanted.b -= 10 / wanted.scale; // the axis labels take their place at the bottom
    const share = firstTime ? 1 : 0.15;
    for (const key of ["a", "b", "scale"]) camera[key] += share * (wanted[key] - camera[key]);
  }

  // The side view looks across the way to the target, from where the vehicle was when that target came.
  turnAxis(frame) {
    const target = frame.route.length ? frame.route[frame.route.length - 1] : null;
    const from = frame.tick ? frame.tick.p : [0, 0, 0], key = target ? target.join() : "";
    if (this.axis && this.axis.key === key && this.axis.placed === Boolean(frame.tick)) return;
    const [x, y] = target ? [target[0] - from[0], target[1] - from[1]] : [0, 0];
    const along = Math.hypot(x, y) > 1;
    const start = along ? this.trail[0] || from : [0, 0, 0];
    const angle = along ? Math.atan2(target[1] - start[1], target[0] - start[0]) : 0;
    const label = along ? "along the way to the target [m]" : "east [m]";
    this.axis = { key, placed: Boolean(frame.tick), origin: start, angle, label };
    document.getElementById("side-axis").textContent = along ? "seen across the way to the target" : "seen from the south";
  }

  describe(frame) {
    const tick = frame.tick;
    const count = tick ? tick.tracks.length + tick.hidden : 0;
    const nearest = tick && tick.clearance !== null ? `, nearest at ${tick.clearance.toFixed(1)} metres` : "";
    const label = tick ? `plan view: vehicle at ${tick.p[0].toFixed(1)} east, ${tick.p[1].toFixed(1)} north, ${tick.p[2].toFixed(1)} up; ${count} obstacles${nearest}` : "plan view, no vehicle yet";
    this.plan.setAttribute("aria-label", label);
    this.side.setAttribute("aria-label", tick ? `side view: vehicle ${tick.p[2].toFixed(1)} metres up` : "side view, no vehicle yet");
  }

  // Zoom and pan: buttons, wheel, drag, pinch, keys.

  zoom(factor, at = null) {
    this.setAuto(false);
    const camera = this.cameras.plan, [x, y] = at || [this.plan.clientWidth / 2, this.plan.clientHeight / 2];
    const dx = x - this.plan.clientWidth / 2, dy = y - this.plan.clientHeight / 2;
    const scale = Math.min(2000, Math.max(0.05, camera.scale * factor));
    camera.a += dx / camera.scale - dx / scale;
    camera.b -= dy / camera.scale - dy / scale;
    camera.scale = scale;
    this.redraw();
  }

  pan(dx, dy) {
    this.setAuto(false);
    this.cameras.plan.a -= dx / this.cameras.plan.scale;
    this.cameras.plan.b += dy / this.cameras.plan.scale;
    this.redraw();
  }

  setAuto(on) {
    this.auto = on;
    document.getElementById("fit").setAttribute("aria-pressed", String(on));
  }

  listen() {
    const press = (id, act) => document.getElementById(id).addEventListener("click", act);
    press("zoom-in", () => this.zoom(1.4));
    press("zoom-out", () => this.zoom(1 / 1.4));
    press("fit", () => { this.setAuto(true); this.cameras.plan.scale = 0; this.redraw(); });
    this.plan.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-0.0015 * event.deltaY), [event.offsetX, event.offsetY]);
    }, { passive: false });
    this.plan.addEventListener("keydown", (event) => {
      const moves = { ArrowLeft: [40, 0], ArrowRight: [-40, 0], ArrowUp: [0, 40], ArrowDown: [0, -40] };
      if (moves[event.key]) this.pan(...moves[event.key]);
      else if (event.key === "+" || event.key === "=") this.zoom(1.4);
      else if (event.key === "-") this.zoom(1 / 1.4);
      else if (event.key === "f" || event.key === "0") document.getElementById("fit").click();
      else return;
      event.preventDefault();
    });
    this.listenToPointers();
    new ResizeObserver(() => this.redraw()).observe(this.plan);
  }

  listenToPointers() {
    const down = new Map();
    let moved = 0;
    this.plan.addEventListener("pointerdown", (event) => {
      down.set(event.pointerId, [event.offsetX, event.offsetY]);
      this.plan.setPointerCapture(event.pointerId);
      moved = 0;
    });
    this.plan.addEventListener("pointermove", (event) => {
      const before = down.get(event.pointerId);
      if (!before) return;
      const now = [event.offsetX, event.offsetY], delta = [now[0] - before[0], now[1] - before[1]];
      moved += Math.hypot(...delta);
      if (moved < 5) return; // a click trembles
      down.set(event.pointerId, now);
      if (down.size === 1) return this.pan(...delta);
      const other = [...down].find(([id]) => id !== event.pointerId)[1];
      const spread = (p) => Math.max(10, Math.hypot(p[0] - other[0], p[1] - other[1]));
      this.zoom(spread(now) / spread(before), [(now[0] + other[0]) / 2, (now[1] + other[1]) / 2]);
    });
    const up = (event) => {
      if (down.delete(event.pointerId) && moved < 5 && event.type === "pointerup") this.pick(event.offsetX, event.offsetY);
    };
    this.plan.addEventListener("pointerup", up);
    this.plan.addEventListener("pointercancel", up);
  }

  pick(x, y) {
    const camera = this.cameras.plan;
    if (!camera.scale) return;
    this.onPick(camera.a + (x - this.plan.clientWidth / 2) / camera.scale, camera.b - (y - this.plan.clientHeight / 2) / camera.scale);
  }
}
