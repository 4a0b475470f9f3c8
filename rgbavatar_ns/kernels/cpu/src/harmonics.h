// Colours .5 + sum Y_k(d) c_k, not below 0, and their gradient. Order, signs and constants are those
// of 3D Gaussian splatting, as in avatar/methods/sh.py.
#pragma once

#include "harmonics_layout.h"
#include "simd.h"

namespace rgbavatar::RGBAVATAR_ISA {

// Harmonics along a direction: values, thrice each as coefficients have three channels, and slopes
// by x, y and z as polynomials.
struct Harmonics {
  float value[kMostHarmonics * 3], slope[3][kMostHarmonics];

  RGBAVATAR_MEMBER void set(int k, float v, float by_x, float by_y, float by_z) {
    value[3 * k] = value[3 * k + 1] = value[3 * k + 2] = v;
    slope[0][k] = by_x;
    slope[1][k] = by_y;
    slope[2][k] = by_z;
  }
};

RGBAVATAR_FUNCTION void harmonics_along(const float* direction, int count, Harmonics& out) {
  const float x = direction[0], y = direction[1], z = direction[2];
  const float xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
  constexpr float k1 = 0.4886025119029199f;
  out.set(0, 0.28209479177387814f, 0.0f, 0.0f, 0.0f);
  out.set(1, -k1 * y, 0.0f, -k1, 0.0f);
  out.set(2, k1 * z, 0.0f, 0.0f, k1);
  out.set(3, -k1 * x, -k1, 0.0f, 0.0f);
  if (count <= 4) return;
  constexpr float a2 = 1.0925484305920792f, b2 = 0.31539156525252005f, c2 = 0.5462742152960396f;
  out.set(4, a2 * xy, a2 * y, a2 * x, 0.0f);
  out.set(5, -a2 * yz, 0.0f, -a2 * z, -a2 * y);
  out.set(6, b2 * (2.0f * zz - xx - yy), -2.0f * b2 * x, -2.0f * b2 * y, 4.0f * b2 * z);
  out.set(7, -a2 * xz, -a2 * z, 0.0f, -a2 * x);
  out.set(8, c2 * (xx - yy), 2.0f * c2 * x, -2.0f * c2 * y, 0.0f);
  if (count <= 9) return;
  constexpr float a3 = 0.5900435899266435f, b3 = 2.890611442640554f, c3 = 0.4570457994644658f;
  constexpr float d3 = 0.3731763325901154f, e3 = 1.445305721320277f;
  const float flat = 4.0f * zz - xx - yy, around = xx - yy, both = 3.0f * (xx + yy);
  out.set(9, -a3 * y * (3.0f * xx - yy), -6.0f * a3 * xy, -3.0f * a3 * around, 0.0f);
  out.set(10, b3 * xy * z, b3 * yz, b3 * xz, b3 * xy);
  out.set(11, -c3 * y * flat, 2.0f * c3 * xy, -c3 * (flat - 2.0f * yy), -8.0f * c3 * yz);
  out.set(12, d3 * z * (2.0f * zz - both), -6.0f * d3 * xz, -6.0f * d3 * yz,
          d3 * (6.0f * zz - both));
  out.set(13, -c3 * x * flat, -c3 * (flat - 2.0f * xx), 2.0f * c3 * xy, -8.0f * c3 * xz);
  out.set(14, e3 * z * around, 2.0f * e3 * xz, -2.0f * e3 * yz, e3 * around);
  out.set(15, -a3 * x * (xx - 3.0f * yy), -3.0f * a3 * around, 6.0f * a3 * xy, 0.0f);
}

// Four coefficients of three channels are taken together, twelve numbers.
constexpr int kTogether = 12;

// The sum over harmonics; one that is left over by fours comes last.
RGBAVATAR_FUNCTION void summed_colors(const Harmonics& along, const float* coefficients, int count,
                                      float* colors) {
  float sums[kTogether] = {};
  const int numbers = 3 * count, whole = numbers / kTogether * kTogether;
  for (int i = 0; i < whole; i += kTogether)
    for (int j = 0; j < kTogether; ++j) sums[j] += along.value[i + j] * coefficients[i + j];
  for (int i = whole; i < numbers; ++i) sums[i - whole] += along.value[i] * coefficients[i];
  for (int c = 0; c < 3; ++c)
    colors[c] = 0.5f + ((sums[c] + sums[c + 3]) + (sums[c + 6] + sums[c + 9]));
}

// Calls each(harmonics, place of the direction, place of the coefficients, whether they come for the
// first time) for the Gaussians [begin, end) of all images.
template <class Each>
RGBAVATAR_FUNCTION void for_directions(const HarmonicScene& s, int begin, int end,
                                       const Each& each) {
  Harmonics basis;
  for (int image = 0; image < s.images; ++image)
    for (int n = begin; n < end; ++n) {
      const int64_t at = (int64_t(image) * s.count + n) * 3;
      const int64_t row = image * s.image_stride + int64_t(n) * s.harmonics * 3;
      harmonics_along(s.directions + at, s.harmonics, basis);
      each(basis, at, row, image == 0 || s.image_stride != 0);
    }
}

// Writes the colours [images, count, 3] of the Gaussians [begin, end).
static void harmonic_colors(const HarmonicScene& s, int begin, int end, float* colors) {
  for_directions(s, begin, end, [&](const Harmonics& basis, int64_t at, int64_t row, bool) {
    float found[3];
    summed_colors(basis, s.coefficients + row, s.harmonics, found);
    for (int c = 0; c < 3; ++c) colors[at + c] = found[c] < 0.0f ? 0.0f : found[c];
  });
}

// Writes the gradients of the coefficients and directions of the Gaussians [begin, end).
static void harmonic_gradient(const HarmonicScene& s, int begin, int end,
                              const float* color_gradient, float* coefficient_gradient,
                              float* direction_gradient) {
  for_directions(s, begin, end, [&](const Harmonics& basis, int64_t at, int64_t row, bool first) {
    const float* own = s.coefficients + row;
    float gradient[3], repeated[3 * kMostHarmonics], by_value[kMostHarmonics];
    summed_colors(basis, own, s.harmonics, gradient);
    for (int c = 0; c < 3; ++c) gradient[c] = gradient[c] < 0.0f ? 0.0f : color_gradient[at + c];
    for (int k = 0; k < s.harmonics; ++k) {
      for (int c = 0; c < 3; ++c) repeated[3 * k + c] = gradient[c];
      by_value[k] =
          own[3 * k] * gradient[0] + own[3 * k + 1] * gradient[1] + own[3 * k + 2] * gradient[2];
    }
    float* out = coefficient_gradient + row;
    if (first)
      for (int i = 0; i < 3 * s.harmonics; ++i) out[i] = basis.value[i] * repeated[i];
    else
      for (int i = 0; i < 3 * s.harmonics; ++i) out[i] += basis.value[i] * repeated[i];
    for (int axis = 0; axis < 3; ++axis) {
      float sum = 0.0f;
      for (int k = 0; k < s.harmonics; ++k) sum += by_value[k] * basis.slope[axis][k];
      direction_gradient[at + axis] = sum;
    }
  });
}

}  // namespace rgbavatar::RGBAVATAR_ISA
