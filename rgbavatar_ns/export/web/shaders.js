"use strict";
/* The three programs of the page: place every Gaussian, draw them, show the result.

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

/** One fragment a Gaussian: base plus weighted bases, activated, placed, projected. */
const PLACE_FRAGMENT = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;
precision highp sampler2DArray;

uniform int count;
uniform int numBases;
uniform int variant;                // of tangent frames: 0 normalized, 1 raw, 2 orthonormal
uniform sampler2D scaleOpacity;     // standard deviations in metres, opacity
uniform sampler2D baseRotation;     // quaternion, real part first
uniform sampler2D baseColor;        // colour, triangle's number
uniform sampler2D basePosition;     // in the triangle's tangent frame
uniform sampler2D anchor;           // two barycentric coordinates, growth of this level of detail
uniform sampler2DArray basisRotation, basisColor, basisPosition;
uniform sampler2D weights;          // psi times units: rows of rotation, colour, position
uniform sampler2D vertex;           // of the posed head
uniform usampler2D corners;         // three vertices' numbers, length at rest or 0 (float's bits)
uniform sampler2D edgesToFrame;
uniform vec3 cameraX, cameraY, cameraZ, cameraTranslation; // rows of world to camera
uniform vec2 focal, principal, slopeLow, slopeHigh;

layout(location = 0) out vec4 place;   // centre and longer half axis in pixels
layout(location = 1) out vec4 shape;   // other half axis in pixels, both in deviations, opacity
layout(location = 2) out vec4 shade;   // colour

${TEXEL}

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
  vec3 local = texelFetch(basePosition, at, 0).xyz;
  for (int k = 0; k < numBases; k++) {
    rotation += texelFetch(weights, ivec2(k, 0), 0) * texelFetch(basisRotation, ivec3(at, k), 0);
    color += texelFetch(weights, ivec2(k, 1), 0).rgb * texelFetch(basisColor, ivec3(at, k), 0).rgb;
    local += texelFetch(weights, ivec2(k, 2), 0).rgb
      * texelFetch(basisPosition, ivec3(at, k), 0).rgb;
  }
  rotation = normalize(rotation);

  // The triangle's tangent frame: along u and v of the texture map, and the outward normal.
  ivec2 face = texel(int(colorTriangle.w));
  uvec4 corner = texelFetch(corners, face, 0);
  vec3 a = texelFetch(vertex, texel(int(corner.x)), 0).xyz;
  vec3 b = texelFetch(vertex, texel(int(corner.y)), 0).xyz;
  vec3 c = texelFetch(vertex, texel(int(corner.z)), 0).xyz;
  vec3 u = b - a, v = c - a, normal = cross(u, v);
  float doubled = length(normal);
  if (doubled * doubled > 1e-10 * dot(u, u) * dot(v, v) + 1e-30) {
    normal /= doubled;
  } else { // without area: the world's axes
    u = vec3(1.0, 0.0, 0.0); v = vec3(0.0, 1.0, 0.0); normal = vec3(0.0, 0.0, 1.0);
  }
  vec4 edges = texelFetch(edgesToFrame, face, 0);
  vec3 tangent = edges.x * u + edges.y * v, bitangent = edges.z * u + edges.w * v;
  if (variant != 1) tangent = normalize(tangent);
  if (variant == 2) bitangent = cross(normal, tangent);
  else if (variant == 0) bitangent = normalize(bitangent);

  vec4 on = texelFetch(anchor, at, 0);
  vec3 world = on.x * a + on.y * b + (1.0 - on.x - on.y) * c
    + local.x * tangent + local.y * bitangent + local.z * normal;
  // The rotation nearest to the frame that keeps the normal: tangent and bitangent turned back by
  // 90 degrees, averaged.
  vec3 back = cross(bitangent, normal);
  vec3 wished = tangent + (dot(back, tangent) < 0.0 ? -back : back);
  vec3 alongU = normalize(wished - dot(wished, normal) * normal);
  mat3 frame = mat3(alongU, cross(normal, alongU), normal);

  vec4 size = texelFetch(scaleOpacity, at, 0);
  float rest = uintBitsToFloat(corner.w);
  vec3 scale = size.xyz * on.z * (rest > 0.0 ? sqrt(max(0.5 * doubled, 1e-16)) / rest : 1.0);

  vec3 centre = toCamera(world) + cameraTranslation;
  if (centre.z < 0.01 || size.w < 1.0 / 255.0) return;
  vec2 slope = centre.xy / centre.z;
  vec2 held = clamp(slope, slopeLow, slopeHigh);
  vec2 perMetre = focal / centre.z;
  vec3 covariance = vec3(0.3, 0.0, 0.3); // xx, xy, yy: the usual low-pass filter
  for (int axis = 0; axis < 3; axis++) {
    vec3 along = vec3(axis == 0, axis == 1, axis == 2) * scale[axis];
    vec3 seen = toCamera(frame * turned(rotation, along));
    vec2 inImage = (seen.xy - held * seen.z) * perMetre;
    covariance += vec3(inImage.x * inImage.x, inImage.x * inImage.y, inImage.y * inImage.y);
  }
  // The ellipse's longer half axis, where alpha falls below 1/255, and the length of the other.
  float middle = 0.5 * (covariance.x + covariance.z);
  float uneven = 0.5 * (covariance.x - covariance.z);
  float apart = length(vec2(uneven, covariance.y));
  float angle = 0.5 * atan(covariance.y, uneven + 1e-20);
  float reach = sqrt(2.0 * log(size.w * 255.0));
  vec2 axes = reach * sqrt(vec2(middle + apart, max(middle - apart, 0.3)));
  place = vec4(focal * slope + principal, axes.x * vec2(cos(angle), sin(angle)));
  shape = vec4(axes.y, reach, size.w, 0.0);
  shade = vec4(vec3(0.5) + 0.28209479177387814 * color, 1.0);
}`;

/** Each Gaussian is a box around the ellipse that may be seen of it. */
const DRAW_VERTEX = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;

uniform usampler2D order; // from far to near
uniform sampler2D place, shape, shade;
uniform vec2 imageSize;
out vec2 deviations; // from the centre, along both axes
flat out vec4 colorOpacity;

${TEXEL}

void main() {
  ivec2 at = texel(int(texelFetch(order, texel(gl_VertexID >> 2), 0).r));
  vec4 box = texelFetch(place, at, 0), rest = texelFetch(shape, at, 0);
  colorOpacity = vec4(texelFetch(shade, at, 0).rgb, rest.z);
  vec2 corner = vec2((gl_VertexID & 1) * 2 - 1, (gl_VertexID & 2) - 1);
  deviations = corner * rest.y;
  vec2 along = box.zw, across = rest.x * normalize(vec2(-along.y, along.x));
  vec2 pixel = box.xy + corner.x * along + corner.y * across;
  gl_Position = vec4(2.0 * pixel.x / imageSize.x - 1.0, 1.0 - 2.0 * pixel.y / imageSize.y, 0.0, 1.0);
  if (rest.x <= 0.0) gl_Position = vec4(2.0, 2.0, 2.0, 1.0); // not to be seen
}`;

const DRAW_FRAGMENT = `#version 300 es
precision highp float;
in vec2 deviations;
flat in vec4 colorOpacity;
out vec4 result;

void main() {
  float alpha = min(0.999, colorOpacity.a * exp(-0.5 * dot(deviations, deviations)));
  if (alpha < 1.0 / 255.0) discard;
  result = vec4(colorOpacity.rgb * alpha, alpha);
}`;

/** The picture over its background, whose colour is premultiplied as the result's is. */
const SHOW_FRAGMENT = `#version 300 es
precision highp float;
precision highp sampler2D;
uniform sampler2D picture; // as large as the canvas or smaller
uniform vec4 background;
uniform vec2 size;         // of the canvas
out vec4 result;

void main() {
  vec4 seen = texture(picture, gl_FragCoord.xy / size);
  seen += (1.0 - seen.a) * background;
  result = vec4(clamp(seen.rgb, 0.0, seen.a), seen.a); // more than alpha would glow
}`;
