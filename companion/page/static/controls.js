// Engage, release and set targets. Shown only where the daemon takes commands; each carries the token.

const SURE_MS = 4000; // engage is asked for twice within this
const element = (id) => document.getElementById(id);

export class Controls {
  constructor(views) {
    this.views = views;
    this.sure = null;
    this.placed = false;
    element("token").value = sessionStorage.getItem("companion-token") || "";
    element("token").addEventListener("change", () => sessionStorage.setItem("companion-token", element("token").value));
    element("token-form").addEventListener("submit", (event) => event.preventDefault());
    element("engage").addEventListener("click", () => this.engage());
    element("release").addEventListener("click", () => this.send("engage", { engaged: false }, "release"));
    element("target-form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.send("target", { position: this.coordinates() }, "target");
    });
    element("target-form").addEventListener("input", () => this.mark());
    element("pick").addEventListener("click", () => this.setPicking(element("pick").getAttribute("aria-pressed") !== "true"));
  }

  show(frame) {
    element("controls").hidden = !frame.commands;
    if (this.placed || !frame.commands || !frame.tick) return;
    this.placed = true; // the altitude flown now is the first one offered
    const [x, y, z] = frame.route[0] || frame.tick.p;
    this.fill(x, y, z);
  }

  fill(x, y, z = null) {
    element("target-x").value = x.toFixed(2);
    element("target-y").value = y.toFixed(2);
    if (z !== null) element("target-z").value = z.toFixed(2);
  }

  coordinates() {
    return ["target-x", "target-y", "target-z"].map((id) => Number(element(id).value));
  }

  mark() {
    const p = this.coordinates();
    this.views.picked = p.every(Number.isFinite) ? p : null;
    this.views.redraw();
  }

  // A click on the plan.
  picked(x, y) {
    if (element("pick").getAttribute("aria-pressed") !== "true") return;
    this.fill(x, y);
    this.mark();
    this.setPicking(false);
    element("target-z").focus();
  }

  setPicking(on) {
    element("pick").setAttribute("aria-pressed", String(on));
    element("plan").classList.toggle("picking", on);
  }

  engage() {
    const button = element("engage"), calm = () => {
      clearTimeout(this.sure);
      this.sure = null;
      button.textContent = "Engage";
      button.classList.remove("sure");
    };
    if (this.sure !== null) {
      calm();
      this.send("engage", { engaged: true }, "engage");
      return;
    }
    button.textContent = "Press again to engage";
    button.classList.add("sure");
    this.sure = setTimeout(calm, SURE_MS);
  }

  async send(path, body, what) {
    const answer = element("answer");
    answer.textContent = `${what} …`;
    try {
      const headers = { "Content-Type": "application/json", Authorization: `Bearer ${element("token").value}` };
      const response = await fetch(`api/${path}`, { method: "POST", headers, body: JSON.stringify(body) });
      const reply = await response.json();
      answer.textContent = reply.accepted ? `${what}: accepted` : `${what}: refused, ${reply.reason}`;
      answer.className = reply.accepted ? "" : "bad";
      if (reply.accepted && path === "target") { this.views.picked = null; this.views.redraw(); }
    } catch {
      answer.textContent = `${what}: no answer from the daemon`;
      answer.className = "bad";
    }
  }
}
