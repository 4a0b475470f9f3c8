"use strict";
/* The recorded performance: theta of frame after frame. */

class RecordedPerformance {
  constructor(data) {
    this.size = data.manifest.layout.reduce((sum, { size }) => sum + size, 0);
    this.theta = data.arrays.theta;
    this.length = this.theta.length / this.size;
    this.framesPerSecond = data.manifest.frames_per_second;
    this.speed = 1;
    this.playing = false;
    this.place = 0; // in frames
  }

  /** Go on by so many seconds; after the last frame comes the first. */
  advance(seconds) {
    const moved = this.place + seconds * this.framesPerSecond * this.speed;
    this.place = this.length > 0 ? moved % this.length : 0;
  }

  /** theta at the current place, linear between frames. */
  current() {
    const first = Math.min(Math.floor(this.place), this.length - 1);
    const second = Math.min(first + 1, this.length - 1);
    const share = this.place - first;
    return Array.from({ length: this.size }, (_, i) => {
      const a = this.theta[first * this.size + i], b = this.theta[second * this.size + i];
      return share > 0 ? a + share * (b - a) : a;
    });
  }
}
