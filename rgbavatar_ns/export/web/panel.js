"use strict";
/* The controls: performance, named expressions, jaw, eyes, head, learned bases, background. */

class Panel {
  /** app: see main.js. Every control writes to it or its avatar, and `show` reads them back. */
  constructor(root, app) {
    this.root = root;
    this.app = app;
    this.avatar = app.avatar;
    this.manifest = app.avatar.data.manifest;
    this.readers = [];
    this.watched = []; // [name, places in theta] of sliders, to tell what is beyond the film
    if (this.avatar.performance.length > 0) this._performance();
    for (const [title, open, entries] of this._thetaGroups()) this._theta(title, open, entries);
    if (this.manifest.num_bases > 0) this._bases();
    this._picture();
    this._help();
  }

  /** Bring all controls to the app's state. */
  show() {
    for (const read of this.readers) read();
  }

  /** Names of the sliders that stand where the film never was. */
  namesBeyond() {
    const beyond = ([, places]) => places.some((place) => this.app.isBeyond(place));
    const names = this.watched.filter(beyond).map(([name]) => name);
    return names.length > 4 ? [...names.slice(0, 4), `${names.length - 4} more`] : names;
  }

  _group(title, open) {
    const group = document.createElement("details");
    group.open = open;
    const summary = document.createElement("summary");
    summary.textContent = title;
    group.append(summary);
    this.root.append(group);
    return group;
  }

  _button(group, text, act) {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = text;
    button.addEventListener("click", () => { act(); this.avatar.changed(); });
    group.append(button);
  }

  /** A labelled slider; `read` gives the app's value, `write` sets it. */
  _slider(group, name, [low, high], read, write, step = (high - low) / 400) {
    const row = document.createElement("div");
    row.className = "row";
    const label = document.createElement("label");
    const input = document.createElement("input");
    const output = document.createElement("output");
    const id = `slider-${name.replace(/\W+/g, "-")}`;
    Object.assign(input, { type: "range", min: low, max: high, step, id });
    label.htmlFor = output.htmlFor = id;
    label.textContent = label.title = name;
    input.addEventListener("input", () => { write(Number(input.value)); this.avatar.changed(); });
    this.readers.push(() => {
      const value = read();
      if (document.activeElement !== input || Number(input.value) !== value) input.value = value;
      output.textContent = value.toFixed(step >= 1 ? 0 : 2);
    });
    row.append(label, input, output);
    group.append(row);
    return row;
  }

  _performance() {
    const { performance } = this.avatar, group = this._group("Performance", true);
    this._slider(group, "Frame", [0, performance.length - 1], () => Math.floor(performance.place),
      (value) => { this.app.takeOver(); performance.seek(value); }, 1);
    this._slider(group, "Speed", [0.1, 2], () => performance.speed,
      (value) => { performance.speed = value; });
  }

  /** Sliders by group: [title, open, [name, place in theta, range, places moved along]]. */
  _thetaGroups() {
    const { layout, expression_names: names, expression_range: range, expression_order: order }
      = this.manifest;
    const { start } = new ThetaFields(layout);
    const turns = (field, reach) => ["nod", "turn", "tilt"].map(
      (name, axis) => [`${field} ${name}`, [start[field] + axis], [-reach, reach]]);
    const face = [["jaw open", [start.jaw], [0, 0.5]], ["jaw sideways", [start.jaw + 1], [-0.2, 0.2]]];
    for (const [name, axis] of [["eyes down", 0], ["eyes sideways", 1]]) {
      face.push([name, [start.left_eye + axis, start.right_eye + axis], [-0.5, 0.5]]);
    }
    if ("eyelids" in start) {
      face.push(["left eyelid", [start.eyelids], [0, 1]], ["right eyelid", [start.eyelids + 1], [0, 1]]);
    }
    return [
      ["Jaw and eyes", true, face],
      ["Head", true, [...turns("neck", 0.8), ...turns("rotation", 0.8)]],
      ["Expressions", true, order.map(
        (i) => [names[i], [start.expression + i], [range[0][i], range[1][i]]])],
    ];
  }

  _theta(title, open, entries) {
    const app = this.app, group = this._group(title, open), neutral = this.avatar.neutralTheta;
    this._button(group, "Reset", () => {
      for (const place of entries.flatMap(([, places]) => places)) {
        app.setParameter(place, neutral[place]);
      }
    });
    const [low, high] = this.manifest.film.theta ?? [];
    for (const [name, places, range] of entries) {
      const row = this._slider(group, name, range, () => this.avatar.theta[places[0]], (value) => {
        for (const place of places) app.setParameter(place, value);
      });
      if (!low) continue;
      const [from, to] = [Math.max(low[places[0]], range[0]), Math.min(high[places[0]], range[1])];
      row.title = `in the film ${from.toFixed(2)} to ${to.toFixed(2)}`;
      const input = row.querySelector("input"), ends = document.createElement("datalist");
      ends.id = `${input.id}-film`; // the browser marks its values on the slider
      const onStep = (value) => range[0] + Math.round((value - range[0]) / input.step) * input.step;
      ends.append(new Option("", onStep(from)), new Option("", onStep(to)));
      input.setAttribute("list", ends.id);
      row.append(ends);
      if (title !== "Head") this.watched.push([name, places]);
      this.readers.push(() => row.classList.toggle("beyond", places.some((p) => app.isBeyond(p))));
    }
  }

  _bases() {
    const { avatar } = this, group = this._group("Learned bases", false);
    this._button(group, "Back to the network", () => {
      this.manifest.psi_range.forEach((_, k) => avatar.holdWeight(k, null));
    });
    this.manifest.psi_range.forEach((reach, k) => {
      const row = this._slider(group, `psi ${k}`, [-reach, reach],
        () => avatar.psi[k] ?? 0, (value) => avatar.holdWeight(k, value));
      this.readers.push(() => row.classList.toggle("held", avatar.isHeld(k)));
    });
  }

  _picture() {
    const { avatar } = this, group = this._group("Picture", false);
    const input = document.createElement("input");
    input.type = "color";
    input.id = "background";
    const byte = (value) => Math.round(255 * value).toString(16).padStart(2, "0");
    input.value = `#${avatar.background.map(byte).join("")}`;
    input.addEventListener("input", () => {
      avatar.background = [1, 3, 5].map((i) => parseInt(input.value.slice(i, i + 2), 16) / 255);
    });
    const label = document.createElement("label");
    label.textContent = "Background ";
    label.append(input);
    group.append(label, document.createElement("br"));
    this._slider(group, "Detail", [0.1, 1], () => avatar.detail, (share) => { avatar.detail = share; });
    const free = document.createElement("input");
    Object.assign(free, { type: "checkbox", id: "turn-freely" });
    free.addEventListener("input", () => { avatar.camera.free = free.checked; avatar.changed(); });
    const freely = document.createElement("label");
    freely.append(free, " Turn freely, beyond what was filmed");
    group.append(freely, document.createElement("br"));
    this._button(group, "Camera back", () => avatar.camera.reset());
    this._button(group, "Save picture", () => this.app.savePicture());
  }

  _help() {
    const group = this._group("Keys and fingers", false), list = document.createElement("dl");
    for (const [what, does] of HELP) {
      const [term, text] = [document.createElement("dt"), document.createElement("dd")];
      [term.textContent, text.textContent] = [what, does];
      list.append(term, text);
    }
    group.append(list);
  }
}
