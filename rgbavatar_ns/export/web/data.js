"use strict";
/* The avatar's numbers: base64 of a gzip of little-endian arrays, listed in the manifest. */

const ARRAY_TYPES = {
  int8: Int8Array, int16: Int16Array, uint16: Uint16Array, uint32: Uint32Array,
  float32: Float32Array,
};

/** Bytes of a base64 text. */
function bytesOfBase64(text) {
  const binary = atob(text.trim());
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < binary.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes;
}

class AvatarData {
  constructor(manifest, arrays) {
    this.manifest = manifest;
    this.arrays = arrays;
    Object.assign(this, manifest, { arrays });
  }

  static async ofPage() {
    const manifest = JSON.parse(document.getElementById("manifest").textContent);
    const element = document.getElementById("payload");
    const packed = new Blob([bytesOfBase64(element.textContent)]);
    element.remove(); // its text is no longer needed and takes memory
    return AvatarData.unpacked(manifest, packed);
  }

  static async open(stream) {
    const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
    const end = 4 + new DataView(bytes.buffer).getUint32(0, true);
    const manifest = JSON.parse(new TextDecoder().decode(bytes.subarray(4, end)));
    return AvatarData.unpacked(manifest, new Blob([bytes.subarray(end)]));
  }

  static async unpacked(manifest, packed) {
    const stream = packed.stream().pipeThrough(new DecompressionStream("gzip"));
    const buffer = await new Response(stream).arrayBuffer();
    const arrays = {};
    for (const [name, { dtype, offset, length }] of Object.entries(manifest.arrays)) {
      arrays[name] = new ARRAY_TYPES[dtype](buffer, offset, length);
    }
    return new AvatarData(manifest, arrays);
  }
}
