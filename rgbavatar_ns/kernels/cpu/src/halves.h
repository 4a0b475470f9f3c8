// Numbers of 16 bits (IEEE 754 binary16, finite) as floats.
#pragma once

#include "simd.h"

namespace rgbavatar::RGBAVATAR_ISA {

RGBAVATAR_FUNCTION void load_halves(Native& a, const uint16_t* from) {
#if defined(__AVX512F__)
  a.v = _mm512_cvtph_ps(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(from)));
#elif defined(__AVX2__)
  a.v = _mm256_cvtph_ps(_mm_loadu_si128(reinterpret_cast<const __m128i*>(from)));
#else
  typedef uint16_t NativeHalf __attribute__((vector_size(2 * kNativeLanes)));
  NativeHalf half;
  __builtin_memcpy(&half, from, sizeof half);
  const NativeUnsigned bits = __builtin_convertvector(half, NativeUnsigned);
  // The float's exponent counts from 127, the half's from 15; subnormal halves follow by themselves.
  const NativeFloat size = (NativeFloat)((bits & 0x7fffu) << 13) * 0x1p112f;
  a.v = (NativeFloat)((NativeUnsigned)size | (bits & 0x8000u) << 16);
#endif
}
template <int L>
RGBAVATAR_FUNCTION void load_halves(Floats<L>& a, const uint16_t* from) {
  load_halves(a.low, from);
  load_halves(a.high, from + L / 2);
}

}  // namespace rgbavatar::RGBAVATAR_ISA
