// Structural similarity and its gradient, a band of rows at a time: each row is blurred across once,
// and the last eleven of them down. Channels lie innermost, so that across means three floats apart.
#pragma once

#include "similarity_layout.h"
#include "simd.h"

namespace rgbavatar::RGBAVATAR_ISA {

// The window's sum over floats `step` apart.
RGBAVATAR_FUNCTION Wide windowed(const float* first, int64_t step, const float* window) {
  Wide sum = load_wide(first) * Wide(window[0]);
  for (int k = 1; k < kTaps; ++k) sum = sum + load_wide(first + k * step) * Wide(window[k]);
  return sum;
}

// The last rows of a ring, from the row `first` on.
struct RingRows {
  const float* row[kTaps];

  RGBAVATAR_MEMBER RingRows(const float* ring, int64_t row_floats, int first) {
    for (int k = 0; k < kTaps; ++k) row[k] = ring + (first + k) % kTaps * row_floats;
  }
  // The window's sum over them.
  RGBAVATAR_MEMBER Wide windowed(int64_t at, const float* window) const {
    Wide sum = load_wide(row[0] + at) * Wide(window[0]);
    for (int k = 1; k < kTaps; ++k) sum = sum + load_wide(row[k] + at) * Wide(window[k]);
    return sum;
  }
};

RGBAVATAR_FUNCTION WideMask first_lanes(int count) {
  static const float lanes[kLanes] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
  return Wide(float(count)) > load_wide(lanes);
}

// The four means across a row of the pictures, into a ring's row.
static void blur_pictures(const SimilarityScene& s, int row, float* rows, float* blurred) {
  const int64_t from = int64_t(row) * s.width;
  float *x = rows, *y = rows + s.stride, *squares = y + s.stride, *product = squares + s.stride;
  __builtin_memcpy(x, s.x + from, s.width * sizeof(float));
  __builtin_memcpy(y, s.y + from, s.width * sizeof(float));
  for (int i = s.width; i < s.stride; ++i) x[i] = y[i] = 0.0f;
  for (int i = 0; i < s.stride; i += kLanes) {
    const Wide a = load_wide(x + i), b = load_wide(y + i);
    store(a * a + b * b, squares + i);
    store(a * b, product + i);
  }
  for (int i = 0; i < s.columns(); i += kLanes)
    for (int m = 0; m < kMeans; ++m)
      store(windowed(rows + m * int64_t(s.stride) + i, kChannels, s.window),
            blurred + m * int64_t(s.stride) + i);
}

// SSIM (Wang et al. 2004, eq. 13) is a1 a2 / (b1 b2) of the means. Returns the sum over the rows
// [begin, end) of windows, and writes the slopes of the mean over all windows by what lies in each.
static double similarity_rows(const SimilarityScene& s, int begin, int end, float* scratch) {
  static_assert(kLanes == kSimilarityLanes, "rows are filled up to whole vectors");
  const int64_t stride = s.stride, row_floats = kMeans * stride;
  float *rows = scratch, *ring = scratch + row_floats;
  const Wide c1(s.c1), c2(s.c2), one(1.0f), two(2.0f), none(0.0f);
  const Wide scale(1.0f / (float(s.rows()) * float(s.columns())));
  double total = 0.0;
  for (int row = begin; row < begin + kTaps - 1; ++row)
    blur_pictures(s, row, rows, ring + (row % kTaps) * row_floats);
  for (int row = begin; row < end; ++row) {
    const int last = row + kTaps - 1;
    blur_pictures(s, last, rows, ring + (last % kTaps) * row_floats);
    const RingRows lines(ring, row_floats, row);
    Wide sum(0.0f);
    for (int i = 0; i < s.columns(); i += kLanes) {
      Wide mean[kMeans];
      for (int m = 0; m < kMeans; ++m) mean[m] = lines.windowed(m * stride + i, s.window);
      const Wide means = mean[0] * mean[1], squares = mean[0] * mean[0] + mean[1] * mean[1];
      const Wide a1 = two * means + c1, a2 = two * (mean[3] - means) + c2;
      const Wide b1 = squares + c1, b2 = mean[2] - squares + c2;
      const Wide inverse = one / (b1 * b2), similarity = a1 * a2 * inverse;
      const WideMask within = first_lanes(s.columns() - i);
      sum = sum + select(within, similarity, none);
      if (!s.slopes) continue;
      const Wide of_squares = none - similarity / b2, of_product = two * a1 * inverse;
      const Wide of_means = two * (a2 - a1) * inverse;
      const Wide of_mean_squares = none - two * (similarity / b1 + of_squares);
      const Wide slopes[kSlopes] = {of_means * mean[1] + of_mean_squares * mean[0], of_squares,
                                    of_product};
      for (int m = 0; m < kSlopes; ++m)
        store(select(within, slopes[m] * scale, none),
              s.slopes + (int64_t(row) * kSlopes + m) * stride + kSlopeMargin + i);
    }
    float lanes[kLanes];
    store(sum, lanes);
    for (float lane : lanes) total += lane;
  }
  return total;
}

// The gradient of the mean by the rows [begin, end) of x: each window gives back what it took.
static void similarity_gradient_rows(const SimilarityScene& s, int begin, int end, float* scratch,
                                     float* gradient) {
  const int64_t stride = s.stride, row_floats = kMeans * stride;
  float *rows = scratch, *ring = scratch + row_floats;
  const Wide two(2.0f);
  for (int row = begin - kTaps + 1; row < end; ++row) {
    float* blurred = ring + ((row + kTaps) % kTaps) * row_floats;
    if (row < 0 || row >= s.rows()) {
      for (int64_t i = 0; i < kSlopes * stride; ++i) blurred[i] = 0.0f;
    } else {
      // From 30 floats before a float up to it, so that the window is taken from its end; it is
      // the same from both.
      for (int i = 0; i < s.width; i += kLanes)
        for (int m = 0; m < kSlopes; ++m)
          store(windowed(s.slopes + (int64_t(row) * kSlopes + m) * stride + i, kChannels, s.window),
                blurred + m * stride + i);
    }
    if (row < begin) continue;
    float *x = rows, *y = rows + stride, *out = y + stride;
    const int64_t from = int64_t(row) * s.width;
    __builtin_memcpy(x, s.x + from, s.width * sizeof(float));
    __builtin_memcpy(y, s.y + from, s.width * sizeof(float));
    const RingRows lines(ring, row_floats, row + 1);
    for (int i = 0; i < s.width; i += kLanes) {
      Wide sums[kSlopes];
      for (int m = 0; m < kSlopes; ++m) sums[m] = lines.windowed(m * stride + i, s.window);
      store(sums[0] + two * load_wide(x + i) * sums[1] + load_wide(y + i) * sums[2], out + i);
    }
    __builtin_memcpy(gradient + from, out, s.width * sizeof(float));
  }
}

}  // namespace rgbavatar::RGBAVATAR_ISA
