"use strict";
/* How much is drawn while something moves, so that pictures follow one another fast enough. */

/** From all to least: how the sums are kept, share of the Gaussians, of each side's pixels. */
const PACE_STEPS = [
  { bytes: false, detail: 1, resolution: 1 },
  { bytes: true, detail: 1, resolution: 1 },
  { bytes: true, detail: 1, resolution: 0.7 },
  { bytes: true, detail: 0.5, resolution: 0.7 },
  { bytes: true, detail: 0.5, resolution: 0.5 },
  { bytes: true, detail: 0.25, resolution: 0.5 },
];
const SLOW = 40, FAST = 20; // milliseconds a picture: 25 and 50 a second
const SLOW_PICTURES = 7; // whose middle one is slow, until less is drawn
const CRAWLING = 160; // milliseconds; then fewer pictures are waited for, and two steps taken
const CRAWLING_PICTURES = 3;
const FAST_PICTURES = 60; // in a row, until more is tried
const LATELY = 300; // pictures, whose shortest interval is as fast as the display goes
const ON_TIME = 1.25; // times that: no picture of the display's was missed
const MOST_PATIENCE = 16; // times as many, where more was too much before
const REST = 250; // milliseconds without a moving picture, until one is drawn in full

class Pace {
  constructor() {
    this.place = 0; // in PACE_STEPS
    this.resting = true;
    this._recent = [];
    this._lately = [];
    this._fast = 0;
    this._patience = 1;
    this._last = null; // when the last moving picture was drawn
    this._drew = null; // the same, if that was the frame before
  }

  /** What is to be drawn now. */
  get share() {
    return PACE_STEPS[this.resting ? 0 : this.place];
  }

  /** In words, empty where all is drawn. */
  get told() {
    const { detail, resolution } = this.share;
    const parts = [];
    if (detail < 1) parts.push(`${Math.round(100 * detail)}% of the Gaussians`);
    if (resolution < 1) parts.push(`${Math.round(100 * resolution)}% of the resolution`);
    return parts.length ? `while moving ${parts.join(", ")}` : "";
  }

  /** Another moving picture is due in this frame of the browser (milliseconds). */
  moves(now) {
    this._frame(now);
    this.resting = false;
    this._last = this._drew = now;
  }

  /** Nothing has moved before this frame; whether a picture in full is due. */
  rests(now) {
    this._frame(now);
    this._drew = null;
    if (this.resting || now - this._last < REST) return false;
    const reduced = this.place > 0;
    this.resting = true;
    this._recent = [];
    return reduced;
  }

  /** The browser's next frame is late where a picture took long; whoever drives may be slow too. */
  _frame(now) {
    if (!this.resting && this._drew !== null) this._judge(now - this._drew);
  }

  _judge(milliseconds) {
    this._fast = this._isFast(milliseconds) ? this._fast + 1 : 0;
    this._recent.push(milliseconds);
    if (this._fast >= FAST_PICTURES * this._patience && this.place > 0) {
      this._go(-1);
      return;
    }
    const steps = this._stepsDown();
    if (this._recent.length === SLOW_PICTURES) this._recent.shift();
    if (steps === 0) return;
    if (this._tried) this._patience = Math.min(2 * this._patience, MOST_PATIENCE);
    this._go(steps);
  }

  /** Fast enough to try more: a display of 50 Hz or slower never gives less than FAST. */
  _isFast(milliseconds) {
    this._lately.push(milliseconds);
    if (this._lately.length > LATELY) this._lately.shift();
    return milliseconds < Math.max(FAST, Math.min(ON_TIME * Math.min(...this._lately), SLOW));
  }

  /** How many steps too much the last pictures were. */
  _stepsDown() {
    const last = this._recent.slice(-CRAWLING_PICTURES), room = PACE_STEPS.length - 1 - this.place;
    if (last.length === CRAWLING_PICTURES && Math.min(...last) > CRAWLING) return Math.min(2, room);
    if (this._recent.length < SLOW_PICTURES) return 0;
    const middle = [...this._recent].sort((a, b) => a - b)[SLOW_PICTURES >> 1];
    return middle > SLOW ? Math.min(1, room) : 0;
  }

  _go(step) {
    this.place += step;
    this._tried = step < 0; // whether it is now more than what was fast enough
    this._recent = [];
    this._fast = 0;
  }
}
