// Four floats of a vector as one value: sums of lanes, and rows that become columns.
#pragma once

#include "simd.h"

namespace rgbavatar::RGBAVATAR_ISA {

typedef float Quad __attribute__((vector_size(16)));
typedef float UnalignedQuad __attribute__((vector_size(16), aligned(4)));

// Four lanes of two quads, those of the second counted from 4.
template <int i, int j, int k, int l>
RGBAVATAR_FUNCTION Quad lanes_of(Quad a, Quad b) {
#if defined(__clang__)
  return __builtin_shufflevector(a, b, i, j, k, l);
#else  // GCC, which has the other name from version 12 on
  typedef int32_t Lanes __attribute__((vector_size(16)));
  return __builtin_shuffle(a, b, Lanes{i, j, k, l});
#endif
}

// The four sums of every fourth lane.
template <int L>
RGBAVATAR_FUNCTION Quad sum_to_quad(Floats<L> a) {
  const Native s = sum_to_register(a);
#if defined(__AVX512F__)
  const __m256 half = _mm512_castps512_ps256(s.v) + _mm512_extractf32x8_ps(s.v, 1);
  return _mm256_castps256_ps128(half) + _mm256_extractf128_ps(half, 1);
#elif defined(__AVX2__)
  return _mm256_castps256_ps128(s.v) + _mm256_extractf128_ps(s.v, 1);
#else
  return s.v;
#endif
}

// The sum of the lanes of each of four quads.
RGBAVATAR_FUNCTION Quad sums_of_quads(Quad a, Quad b, Quad c, Quad d) {
  const Quad ab = lanes_of<0, 4, 1, 5>(a, b) + lanes_of<2, 6, 3, 7>(a, b);
  const Quad cd = lanes_of<0, 4, 1, 5>(c, d) + lanes_of<2, 6, 3, 7>(c, d);
  return lanes_of<0, 1, 4, 5>(ab, cd) + lanes_of<2, 3, 6, 7>(ab, cd);
}

// Four sums of lanes at a time.
template <int L>
RGBAVATAR_FUNCTION Quad sums_of(Floats<L> a, Floats<L> b, Floats<L> c, Floats<L> d) {
#if defined(__AVX512F__)
  const auto fold = [](__m512 x, __m512 y) __attribute__((always_inline)) {
    return _mm512_shuffle_f32x4(x, y, 0x44) + _mm512_shuffle_f32x4(x, y, 0xee);
  };
  const __m512 ab = fold(a.v, b.v), cd = fold(c.v, d.v);
  // Quads: [a, b, c, d], each with the lanes' sums modulo four.
  const __m512 quads =
      _mm512_shuffle_f32x4(ab, cd, 0x88) + _mm512_shuffle_f32x4(ab, cd, 0xdd);
  const __m512 pairs = quads + _mm512_shuffle_ps(quads, quads, 0x4e);
  const __m512 sums = pairs + _mm512_shuffle_ps(pairs, pairs, 0xb1);
  const __m512i every_fourth = _mm512_setr_epi32(0, 4, 8, 12, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0);
  return _mm512_castps512_ps128(_mm512_permutexvar_ps(every_fourth, sums));
#else
  return sums_of_quads(sum_to_quad(a), sum_to_quad(b), sum_to_quad(c), sum_to_quad(d));
#endif
}

// The sum of the lanes.
template <int L>
RGBAVATAR_FUNCTION float sum_of(Floats<L> a) {
  const Quad q = sum_to_quad(a);
  return (q[0] + q[2]) + (q[1] + q[3]);
}

// Lanes 4i ... 4i + 3.
template <int i>
RGBAVATAR_FUNCTION Quad quad_of(Native a) {
#if defined(__AVX512F__)
  return _mm512_extractf32x4_ps(a.v, i);
#elif defined(__AVX2__)
  return _mm256_extractf128_ps(a.v, i);
#else
  return a.v;
#endif
}
template <int i, int L>
RGBAVATAR_FUNCTION Quad quad_of(Floats<L> a) {
  if constexpr (i < L / 8)
    return quad_of<i>(a.low);
  else
    return quad_of<i - L / 8>(a.high);
}

RGBAVATAR_FUNCTION Wide wide_of(Quad a, Quad b, Quad c, Quad d) {
#if defined(__AVX512F__)
  const __m512 ab = _mm512_insertf32x4(_mm512_castps128_ps512(a), b, 1);
  const __m256 cd = _mm256_insertf128_ps(_mm256_castps128_ps256(c), d, 1);
  return Wide(_mm512_insertf32x8(ab, cd, 1));
#elif defined(__AVX2__)
  return Wide(Native(_mm256_insertf128_ps(_mm256_castps128_ps256(a), b, 1)),
              Native(_mm256_insertf128_ps(_mm256_castps128_ps256(c), d, 1)));
#else
  return Wide({Native(a), Native(b)}, {Native(c), Native(d)});
#endif
}

// Rows become columns.
RGBAVATAR_FUNCTION void transpose(Quad& a, Quad& b, Quad& c, Quad& d) {
  const Quad ab = lanes_of<0, 4, 1, 5>(a, b);
  const Quad ab2 = lanes_of<2, 6, 3, 7>(a, b);
  const Quad cd = lanes_of<0, 4, 1, 5>(c, d);
  const Quad cd2 = lanes_of<2, 6, 3, 7>(c, d);
  a = lanes_of<0, 1, 4, 5>(ab, cd);
  b = lanes_of<2, 3, 6, 7>(ab, cd);
  c = lanes_of<0, 1, 4, 5>(ab2, cd2);
  d = lanes_of<2, 3, 6, 7>(ab2, cd2);
}

RGBAVATAR_FUNCTION Quad load_quad(const float* from) {
  return *reinterpret_cast<const UnalignedQuad*>(from);
}
RGBAVATAR_FUNCTION void store_quad(Quad a, float* to) {
  *reinterpret_cast<UnalignedQuad*>(to) = a;
}

// Four pixels' r, g, b as r0 g0 b0 r1 ..., and back.
RGBAVATAR_FUNCTION void store_interleaved(Quad r, Quad g, Quad b, float* to) {
  const Quad rg = lanes_of<0, 4, 1, 5>(r, g);   // r0 g0 r1 g1
  const Quad rg2 = lanes_of<2, 6, 3, 7>(r, g);  // r2 g2 r3 g3
  const Quad br = lanes_of<0, 5, 1, 0>(b, r);   // b0 r1 b1 .
  const Quad gb = lanes_of<1, 5, 3, 7>(g, b);   // g1 b1 g3 b3
  const Quad b2 = lanes_of<2, 7, 2, 7>(b, r);   // b2 r3 . .
  store_quad(lanes_of<0, 1, 4, 5>(rg, br), to);
  store_quad(lanes_of<0, 1, 4, 5>(gb, rg2), to + 4);
  store_quad(lanes_of<0, 1, 6, 7>(b2, gb), to + 8);
}
RGBAVATAR_FUNCTION void load_interleaved(const float* from, Quad& r, Quad& g, Quad& b) {
  const Quad x = load_quad(from);      // r0 g0 b0 r1
  const Quad y = load_quad(from + 4);  // g1 b1 r2 g2
  const Quad z = load_quad(from + 8);  // b2 r3 g3 b3
  const Quad r23 = lanes_of<2, 2, 5, 5>(y, z);
  const Quad g01 = lanes_of<1, 1, 4, 4>(x, y);
  const Quad g23 = lanes_of<3, 3, 6, 6>(y, z);
  const Quad b01 = lanes_of<2, 2, 5, 5>(x, y);
  r = lanes_of<0, 3, 4, 6>(x, r23);
  g = lanes_of<0, 2, 4, 6>(g01, g23);
  b = lanes_of<0, 2, 4, 7>(b01, z);
}

// The largest lane; all are at least 0.
template <int L>
RGBAVATAR_FUNCTION float max_lane(Floats<L> a) {
  float lanes[L], largest = 0.0f;
  store(a, lanes);
  for (int i = 0; i < L; ++i) largest = largest < lanes[i] ? lanes[i] : largest;
  return largest;
}

// Of the four 4 x 4 matrices whose rows are the quarters of a, b, c, d.
RGBAVATAR_FUNCTION void transpose_quarters(Native& a, Native& b, Native& c, Native& d) {
#if defined(__AVX512F__)
  const __m512 ab = _mm512_unpacklo_ps(a.v, b.v), ab2 = _mm512_unpackhi_ps(a.v, b.v);
  const __m512 cd = _mm512_unpacklo_ps(c.v, d.v), cd2 = _mm512_unpackhi_ps(c.v, d.v);
  a.v = _mm512_shuffle_ps(ab, cd, 0x44);
  b.v = _mm512_shuffle_ps(ab, cd, 0xee);
  c.v = _mm512_shuffle_ps(ab2, cd2, 0x44);
  d.v = _mm512_shuffle_ps(ab2, cd2, 0xee);
#elif defined(__AVX2__)
  const __m256 ab = _mm256_unpacklo_ps(a.v, b.v), ab2 = _mm256_unpackhi_ps(a.v, b.v);
  const __m256 cd = _mm256_unpacklo_ps(c.v, d.v), cd2 = _mm256_unpackhi_ps(c.v, d.v);
  a.v = _mm256_shuffle_ps(ab, cd, 0x44);
  b.v = _mm256_shuffle_ps(ab, cd, 0xee);
  c.v = _mm256_shuffle_ps(ab2, cd2, 0x44);
  d.v = _mm256_shuffle_ps(ab2, cd2, 0xee);
#else
  transpose(a.v, b.v, c.v, d.v);
#endif
}
template <int L>
RGBAVATAR_FUNCTION void transpose_quarters(Floats<L>& a, Floats<L>& b, Floats<L>& c,
                                           Floats<L>& d) {
  transpose_quarters(a.low, b.low, c.low, d.low);
  transpose_quarters(a.high, b.high, c.high, d.high);
}

// Four columns of sixteen rows of floats; `row(i)` is where the four numbers of row i begin.
template <class Row>
RGBAVATAR_FUNCTION void load_columns(const Row& row, Wide out[4]) {
  // Rows four apart share a register, so that the columns come out in order.
  for (int i = 0; i < 4; ++i)
    out[i] = wide_of(load_quad(row(i)), load_quad(row(4 + i)), load_quad(row(8 + i)),
                     load_quad(row(12 + i)));
  transpose_quarters(out[0], out[1], out[2], out[3]);
}

// The other way.
template <int i, class Row>
RGBAVATAR_FUNCTION void store_quarters(const Wide v[4], const Row& row) {
  for (int k = 0; k < 4; ++k) store_quad(quad_of<i>(v[k]), row(4 * i + k));
}
template <class Row>
RGBAVATAR_FUNCTION void store_columns(const Wide in[4], const Row& row) {
  Wide v[4] = {in[0], in[1], in[2], in[3]};
  transpose_quarters(v[0], v[1], v[2], v[3]);
  store_quarters<0>(v, row);
  store_quarters<1>(v, row);
  store_quarters<2>(v, row);
  store_quarters<3>(v, row);
}

}  // namespace rgbavatar::RGBAVATAR_ISA
