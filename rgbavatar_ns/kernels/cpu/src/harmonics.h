// Colours .5 + sum Y_k(d) c_k, not below 0, and their gradient. Order, signs and constants are those
// of 3D Gaussian splatting, as in avatar/methods/sh.py.
#pragma once

#include "harmonics_layout.h"
#include "simd.h"

namespace rgbavatar::RGBAVATAR_ISA {

// A harmonic's value along a direction, and its slopes by x, y and z as a polynomial.
struct Harmonic {
  float value, slope[3];
};

RGBAVATAR_FUNCTION void harmonics_along(const float* direction, int count, Harmonic* out) {
  const float x = direction[0], y = direction[1], z = direction[2];
  const float xx = x * x, yy = y * y, zz = z * z;
  constexpr float k1 = 0.4886025119029199f;
  out[0] = {0.28209479177387814f, {0.0f, 0.0f, 0.0f}};
  out[1] = {-k1 * y, {0.0f, -k1, 0.0f}};
  out[2] = {k1 * z, {0.0f, 0.0f, k1}};
  out[3] = {-k1 * x, {-k1, 0.0f, 0.0f}};
  if (count <= 4) return;
  constexpr float a2 = 1.0925484305920792f, b2 = 0.31539156525252005f, c2 = 0.5462742152960396f;
  out[4] = {a2 * x * y, {a2 * y, a2 * x, 0.0f}};
  out[5] = {-a2 * y * z, {0.0f, -a2 * z, -a2 * y}};
  out[6] = {b2 * (2.0f * zz - xx - yy), {-2.0f * b2 * x, -2.0f * b2 * y, 4.0f * b2 * z}};
  out[7] = {-a2 * x * z, {-a2 * z, 0.0f, -a2 * x}};
  out[8] = {c2 * (xx - yy), {2.0f * c2 * x, -2.0f * c2 * y, 0.0f}};
  if (count <= 9) return;
  constexpr float a3 = 0.5900435899266435f, b3 = 2.890611442640554f, c3 = 0.4570457994644658f;
  constexpr float d3 = 0.3731763325901154f, e3 = 1.445305721320277f;
  const float flat = 4.0f * zz - xx - yy;
  out[9] = {-a3 * y * (3.0f * xx - yy), {-6.0f * a3 * x * y, -3.0f * a3 * (xx - yy), 0.0f}};
  out[10] = {b3 * x * y * z, {b3 * y * z, b3 * x * z, b3 * x * y}};
  out[11] = {-c3 * y * flat, {2.0f * c3 * x * y, -c3 * (flat - 2.0f * yy), -8.0f * c3 * y * z}};
  out[12] = {d3 * z * (2.0f * zz - 3.0f * (xx + yy)),
             {-6.0f * d3 * x * z, -6.0f * d3 * y * z, d3 * (6.0f * zz - 3.0f * (xx + yy))}};
  out[13] = {-c3 * x * flat, {-c3 * (flat - 2.0f * xx), 2.0f * c3 * x * y, -8.0f * c3 * x * z}};
  out[14] = {e3 * z * (xx - yy), {2.0f * e3 * x * z, -2.0f * e3 * y * z, e3 * (xx - yy)}};
  out[15] = {-a3 * x * (xx - 3.0f * yy), {-3.0f * a3 * (xx - yy), 6.0f * a3 * x * y, 0.0f}};
}

RGBAVATAR_FUNCTION void summed_colors(const Harmonic* basis, const float* coefficients, int count,
                                      float* colors) {
  for (int c = 0; c < 3; ++c) colors[c] = 0.5f;
  for (int k = 0; k < count; ++k)
    for (int c = 0; c < 3; ++c) colors[c] += basis[k].value * coefficients[3 * k + c];
}

// Writes the colours [images, count, 3] of the Gaussians [begin, end).
static void harmonic_colors(const HarmonicScene& s, int begin, int end, float* colors) {
  Harmonic basis[kMostHarmonics];
  for (int image = 0; image < s.images; ++image)
    for (int n = begin; n < end; ++n) {
      const int64_t at = (int64_t(image) * s.count + n) * 3;
      harmonics_along(s.directions + at, s.harmonics, basis);
      const int64_t row = image * s.image_stride + int64_t(n) * s.harmonics * 3;
      float found[3];
      summed_colors(basis, s.coefficients + row, s.harmonics, found);
      for (int c = 0; c < 3; ++c) colors[at + c] = found[c] < 0.0f ? 0.0f : found[c];
    }
}

// Writes the gradients of the coefficients and directions of the Gaussians [begin, end).
static void harmonic_gradient(const HarmonicScene& s, int begin, int end,
                              const float* color_gradient, float* coefficient_gradient,
                              float* direction_gradient) {
  Harmonic basis[kMostHarmonics];
  for (int image = 0; image < s.images; ++image)
    for (int n = begin; n < end; ++n) {
      const int64_t at = (int64_t(image) * s.count + n) * 3;
      harmonics_along(s.directions + at, s.harmonics, basis);
      const int64_t row = image * s.image_stride + int64_t(n) * s.harmonics * 3;
      const float* own = s.coefficients + row;
      float gradient[3], along[3] = {0.0f, 0.0f, 0.0f};
      summed_colors(basis, own, s.harmonics, gradient);
      for (int c = 0; c < 3; ++c)
        gradient[c] = gradient[c] < 0.0f ? 0.0f : color_gradient[at + c];
      float* out = coefficient_gradient + row;
      const bool first = image == 0 || s.image_stride != 0;
      for (int k = 0; k < s.harmonics; ++k) {
        float by_value = 0.0f;
        for (int c = 0; c < 3; ++c) {
          const float part = basis[k].value * gradient[c];
          out[3 * k + c] = first ? part : out[3 * k + c] + part;
          by_value += own[3 * k + c] * gradient[c];
        }
        for (int axis = 0; axis < 3; ++axis) along[axis] += by_value * basis[k].slope[axis];
      }
      for (int axis = 0; axis < 3; ++axis) direction_gradient[at + axis] = along[axis];
    }
}

}  // namespace rgbavatar::RGBAVATAR_ISA
