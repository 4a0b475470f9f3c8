"use strict";
/* The avatar's file (avatar_file.py says what it is like), read while it arrives. */

const FILE_NAME = "rgbavatr", FILE_VERSION = 2, HEADER_BYTES = 16;
const MOST_MANIFEST_BYTES = 1 << 24, MOST_ARRAY_BYTES = 2 ** 31;
const ARRAY_TYPES = {
  int8: Int8Array, uint8: Uint8Array, int16: Int16Array, uint16: Uint16Array, uint32: Uint32Array,
  float32: Float32Array,
};

class AvatarData {
  /**
   * Resolves as soon as there is enough to draw: the mesh and the first Gaussians. The rest goes on
   * arriving. source: a ReadableStream of bytes. Rejects with an Error that says what is wrong.
   */
  static async open(source) {
    const bytes = new ByteReader(source);
    try {
      if (typeof DecompressionStream === "undefined") {
        throw new Error("This browser cannot unpack the avatar's file (it has no "
          + "DecompressionStream). Use one of 2023 or later.");
      }
      const data = new AvatarData(await readManifest(bytes));
      await data._readPart(bytes);
      data.complete = data._readOn(bytes);
      data.complete.catch(() => {}); // told to whom it is asked by, and only to them
      return data;
    } catch (error) {
      bytes.cancel();
      throw asDamage(error);
    }
  }

  constructor(manifest) {
    this.manifest = manifest;
    this.arrays = {}; // in full from the start, zero where nothing has arrived
    this.available = 0; // so many Gaussians are there
    this.spans = []; // first and last Gaussian that each part so far brought something of
    this.arrivals = new Set(); // called after each further part
    for (const [name, { dtype, columns, items }] of Object.entries(manifest.arrays)) {
      this.arrays[name] = allocated(ARRAY_TYPES[dtype], columns * items);
    }
  }

  async _readOn(bytes) {
    try {
      while (this.spans.length < this.manifest.parts.length) {
        await this._readPart(bytes);
        for (const arrived of this.arrivals) arrived();
      }
    } catch (error) {
      bytes.cancel();
      throw asDamage(error);
    }
  }

  async _readPart(bytes) {
    const { manifest, arrays } = this;
    const part = manifest.parts[this.spans.length];
    const block = await inflated(await bytes.read(part.bytes));
    let place = 0, from = Infinity, to = 0;
    for (const [name, first, last] of part.slices) {
      const described = manifest.arrays[name];
      const length = described.columns * (last - first) * ARRAY_TYPES[described.stored].BYTES_PER_ELEMENT;
      if (place + length > block.length) throw new Error("The avatar's file is damaged.");
      unpackInto(arrays[name], described, first, block.subarray(place, place + length));
      place += length;
      if (described.items === manifest.num_gaussians) {
        from = Math.min(from, first);
        to = Math.max(to, last);
      }
    }
    this.available = part.available;
    this.spans.push([Math.min(from, to), to]);
  }
}

/** An array of zeros; what is too much for this machine alone is no damage of the file's. */
function allocated(Type, length) {
  try {
    return new Type(length);
  } catch (error) {
    const bytes = length * Type.BYTES_PER_ELEMENT;
    if (!(error instanceof RangeError) || !(bytes >= 0 && bytes <= MOST_ARRAY_BYTES)) throw error;
    throw new Error("There is not enough memory left for the avatar. Close other pages.");
  }
}

/** A manifest that asks for what cannot be fails with an error of the language's own. */
function asDamage(error) {
  const own = error.constructor === Error || error.name === "AbortError";
  return own ? error : new Error("The avatar's file is damaged.", { cause: error });
}

/** Takes pieces of any length from a stream. */
class ByteReader {
  constructor(stream) {
    this.reader = stream.getReader();
    this.chunks = [];
    this.length = 0; // of the chunks
    this.total = 0; // read since the start
  }

  /** Exactly so many bytes. */
  async read(count) {
    while (this.length < count) {
      const { value, done } = await this._next();
      if (done) throw new Error(`The avatar's file is cut off after ${this.total} bytes.`);
      this.chunks.push(value);
      this.length += value.length;
      this.total += value.length;
    }
    const bytes = new Uint8Array(count);
    for (let place = 0; place < count;) {
      const taken = this.chunks[0].subarray(0, count - place);
      bytes.set(taken, place);
      place += taken.length;
      if (taken.length === this.chunks[0].length) this.chunks.shift();
      else this.chunks[0] = this.chunks[0].subarray(taken.length);
    }
    this.length -= count;
    return bytes;
  }

  async _next() {
    try {
      return await this.reader.read();
    } catch (error) {
      if (error.constructor === Error || error.name === "AbortError") throw error;
      throw new Error(`The connection was lost after ${this.total} bytes of the avatar's file. `
        + "Load the page again.", { cause: error });
    }
  }

  cancel() {
    this.reader.cancel().catch(() => {});
  }
}

async function readManifest(bytes) {
  const name = new TextDecoder("latin1").decode(await bytes.read(FILE_NAME.length));
  if (name !== FILE_NAME) throw new Error("This is no avatar's file.");
  const header = new DataView((await bytes.read(HEADER_BYTES - FILE_NAME.length)).buffer);
  const version = header.getUint32(0, true), length = header.getUint32(4, true);
  if (version !== FILE_VERSION) {
    throw new Error(`The avatar's file has version ${version}; this program reads ${FILE_VERSION}. `
      + "Export the avatar again.");
  }
  if (length > MOST_MANIFEST_BYTES) throw new Error("The avatar's file is damaged.");
  return JSON.parse(new TextDecoder().decode(await inflated(await bytes.read(length))));
}

/** What a gzip holds; its checksum is compared. */
async function inflated(packed) {
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  try {
    return new Uint8Array(await new Response(stream).arrayBuffer());
  } catch {
    throw new Error("The avatar's file is damaged.");
  }
}

/** Unpack the columns of some items, the first of which has the number `first`, into an array. */
function unpackInto(target, described, first, block) {
  const { stored, dtype, columns, items, unit, low, logarithmic, differences } = described;
  const Stored = ARRAY_TYPES[stored], size = Stored.BYTES_PER_ELEMENT;
  const count = block.length / (columns * size);
  const bytes = new Uint8Array(size * count), values = new Stored(bytes.buffer);
  const scaled = dtype === "float32" && unit !== null;
  for (let column = 0; column < columns; column++) {
    for (let byte = 0; byte < size; byte++) {
      const plane = count * (size * column + byte);
      for (let i = 0; i < count; i++) bytes[size * i + byte] = block[plane + i];
    }
    if (stored === "int16") {
      for (let i = 0; i < count; i++) values[i] = ((values[i] & 0xffff) >> 1) ^ -(values[i] & 1);
    }
    if (differences) for (let i = 1; i < count; i++) values[i] += values[i - 1];
    const [place, stride] = described.by_item ? [columns * first + column, columns]
      : [items * column + first, 1];
    for (let i = 0; i < count; i++) {
      let value = values[i];
      if (scaled) value = low[column] + unit[column] * value;
      target[place + stride * i] = logarithmic ? Math.exp(value) : value;
    }
  }
}

/** Bytes of a base64 text. */
function bytesOfBase64(text) {
  let binary;
  try {
    binary = atob(text.trim());
  } catch {
    throw new Error("The avatar's file is damaged.");
  }
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < binary.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes;
}

/** The file in the page's own elements, each as soon as the browser has read it. */
function streamOfPage() {
  return new ReadableStream({
    async pull(controller) {
      const element = await nextPart();
      if (element === null) return controller.close();
      controller.enqueue(bytesOfBase64(element.textContent));
      element.remove(); // its text is no longer needed and takes memory
    },
  });
}

/** Resolves to the page's next complete part, or null after the last one. */
function nextPart() {
  return new Promise((resolve) => {
    const look = () => {
      const element = document.querySelector("script.part");
      const whole = document.readyState !== "loading";
      if (!whole && !element?.nextElementSibling) return;
      observer.disconnect();
      document.removeEventListener("DOMContentLoaded", look);
      resolve(element);
    };
    const observer = new MutationObserver(look);
    observer.observe(document.body, { childList: true });
    document.addEventListener("DOMContentLoaded", look);
    look();
  });
}
