"use strict";
/* The three programs of the page: blend every Gaussian, draw them, show the result.

The rule is that of the project's rasterizer: camera axes x right, y down, z forward; lengths in
metres; image coordinates in pixels from the upper left corner; an alpha is
min(0.999, opacity exp(-d^T cov^-1 d / 2)), dropped below 1/255. */

/** Texels lie in rows of 1,024. */
const TEXEL = `
ivec2 texel(int index) { return ivec2(index & 1023, index >> 10); }
`;

const WHOLE_TARGET_VERTEX = `#version 300 es
void main() {
  vec2 corner = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
  gl_Position = vec4(corner, 0.0, 1.0);
}`;

/** One fragment a Gaussian: base plus weighted bases, activated, projected into the image. */
const BLEND_FRAGMENT = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp sampler2DArray;

uniform int count;
uniform int numBases;
uniform sampler2D scaleOpacity;     // standard deviations in metres, opacity
uniform sampler2D baseRotation;     // quaternion, real part first
uniform sampler2D baseColor;        // colour, triangle's number
uniform sampler2DArray basisRotation;
uniform sampler2DArray basisColor;
uniform sampler2D weights;          // psi times the bases' units: row 0 rotation, row 1 colour
uniform sampler2D position;         // world position, growth of the triangle
uniform sampler2D triangleRotation; // quaternion, real part first
uniform vec3 cameraX, cameraY, cameraZ, cameraTranslation; // rows of world to camera
uniform vec2 focal, principal, slopeLow, slopeHigh;

layout(location = 0) out vec4 place;   // centre in pixels, half size of its box in pixels
layout(location = 1) out vec4 shape;   // inverse covariance xx, xy, yy, opacity
layout(location = 2) out vec4 shade;   // colour

${TEXEL}

vec4 product(vec4 p, vec4 q) { // Hamilton product, real part in x
  return vec4(p.x * q.x - dot(p.yzw, q.yzw), p.x * q.yzw + q.x * p.yzw + cross(p.yzw, q.yzw));
}

vec3 turned(vec4 q, vec3 v) {
  vec3 t = 2.0 * cross(q.yzw, v);
  return v + q.x * t + cross(q.yzw, t);
}

vec3 toCamera(vec3 v) { return vec3(dot(cameraX, v), dot(cameraY, v), dot(cameraZ, v)); }

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  place = vec4(0.0); shape = vec4(0.0); shade = vec4(0.0);
  if (at.y * 1024 + at.x >= count) return;

  vec4 rotation = texelFetch(baseRotation, at, 0);
  vec4 colorTriangle = texelFetch(baseColor, at, 0);
  vec3 color = colorTriangle.rgb;
  for (int k = 0; k < numBases; k++) {
    rotation += texelFetch(weights, ivec2(k, 0), 0) * texelFetch(basisRotation, ivec3(at, k), 0);
    color += texelFetch(weights, ivec2(k, 1), 0).rgb * texelFetch(basisColor, ivec3(at, k), 0).rgb;
  }
  vec4 frame = texelFetch(triangleRotation, texel(int(colorTriangle.w)), 0);
  rotation = normalize(product(frame, rotation));
  vec4 world = texelFetch(position, at, 0);
  vec4 size = texelFetch(scaleOpacity, at, 0);
  vec3 scale = size.xyz * world.w;

  vec3 centre = toCamera(world.xyz) + cameraTranslation;
  if (centre.z < 0.01 || size.w < 1.0 / 255.0) return;
  vec2 slope = centre.xy / centre.z;
  vec2 held = clamp(slope, slopeLow, slopeHigh);
  vec2 perMetre = focal / centre.z;
  vec3 covariance = vec3(0.3, 0.0, 0.3); // xx, xy, yy: the usual low-pass filter
  for (int axis = 0; axis < 3; axis++) {
    vec3 along = vec3(axis == 0, axis == 1, axis == 2) * scale[axis];
    vec3 seen = toCamera(turned(rotation, along));
    vec2 inImage = (seen.xy - held * seen.z) * perMetre;
    covariance += vec3(inImage.x * inImage.x, inImage.x * inImage.y, inImage.y * inImage.y);
  }
  float determinant = covariance.x * covariance.z - covariance.y * covariance.y;
  float reach = sqrt(2.0 * log(size.w * 255.0));
  place = vec4(focal * slope + principal, reach * sqrt(covariance.xz));
  shape = vec4(covariance.z, -covariance.y, covariance.x, 0.0) / determinant;
  shape.w = size.w;
  shade = vec4(vec3(0.5) + 0.28209479177387814 * color, 1.0);
}`;

/** Each Gaussian is a box around what may be seen of it. */
const DRAW_VERTEX = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;

uniform usampler2D order; // from far to near
uniform sampler2D place, shape, shade;
uniform vec2 imageSize;
out vec2 offset;
flat out vec4 conicOpacity;
flat out vec3 color;

${TEXEL}

void main() {
  ivec2 at = texel(int(texelFetch(order, texel(gl_VertexID >> 2), 0).r));
  vec4 box = texelFetch(place, at, 0);
  conicOpacity = texelFetch(shape, at, 0);
  color = texelFetch(shade, at, 0).rgb;
  offset = box.zw * vec2((gl_VertexID & 1) * 2 - 1, (gl_VertexID & 2) - 1);
  vec2 pixel = box.xy + offset;
  gl_Position = vec4(2.0 * pixel.x / imageSize.x - 1.0, 1.0 - 2.0 * pixel.y / imageSize.y, 0.0, 1.0);
  if (box.z <= 0.0) gl_Position = vec4(2.0, 2.0, 2.0, 1.0); // not to be seen
}`;

const DRAW_FRAGMENT = `#version 300 es
precision highp float;
in vec2 offset;
flat in vec4 conicOpacity;
flat in vec3 color;
out vec4 result;

void main() {
  float squared = conicOpacity.x * offset.x * offset.x + conicOpacity.z * offset.y * offset.y
    + 2.0 * conicOpacity.y * offset.x * offset.y;
  float alpha = min(0.999, conicOpacity.w * exp(-0.5 * squared));
  if (alpha < 1.0 / 255.0) discard;
  result = vec4(color * alpha, alpha);
}`;

/** The picture over its background, whose colour is premultiplied as the result's is. */
const SHOW_FRAGMENT = `#version 300 es
precision highp float;
precision highp sampler2D;
uniform sampler2D picture;
uniform vec4 background;
out vec4 result;

void main() {
  vec4 seen = texelFetch(picture, ivec2(gl_FragCoord.xy), 0);
  seen += (1.0 - seen.a) * background;
  result = vec4(clamp(seen.rgb, 0.0, seen.a), seen.a); // more than alpha would glow
}`;
