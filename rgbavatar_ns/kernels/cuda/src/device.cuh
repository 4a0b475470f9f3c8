// The formulas for one float a thread, and what a warp does together.
#define RGBAVATAR_FUNCTION __device__ __forceinline__

RGBAVATAR_FUNCTION float select(bool mask, float a, float b) { return mask ? a : b; }
RGBAVATAR_FUNCTION float min_of(float a, float b) { return fminf(a, b); }
RGBAVATAR_FUNCTION float max_of(float a, float b) { return fmaxf(a, b); }
RGBAVATAR_FUNCTION float log2_of(float a) { return log2f(a); }

// One instruction each, for 0 and normal numbers within two units in the last place; the rounding
// of IEEE would take about ten, and a subroutine for the rest.
#if defined(__CUDA_ARCH__)
#define RGBAVATAR_QUICK(name, instruction, exact)        \
  RGBAVATAR_FUNCTION float name(float a) {               \
    float out;                                           \
    asm(instruction ".f32 %0, %1;" : "=f"(out) : "f"(a)); \
    return out;                                          \
  }
#else
#define RGBAVATAR_QUICK(name, instruction, exact) \
  RGBAVATAR_FUNCTION float name(float a) { return exact; }
#endif
RGBAVATAR_QUICK(square_root, "sqrt.approx.ftz", sqrtf(a))
RGBAVATAR_QUICK(inverse_root_of, "rsqrt.approx.ftz", 1.0f / sqrtf(a))
RGBAVATAR_QUICK(reciprocal_of, "rcp.approx.ftz", 1.0f / a)
RGBAVATAR_QUICK(power_of_two, "ex2.approx.ftz", exp2f(a))  // of exponents from -126 to 126

#include "gaussian_math.h"
#include "tangent_math.h"

typedef BlendingConstants C;
constexpr unsigned kWholeWarp = 0xffffffffu;
constexpr int kTileSide = 16;
constexpr int kTileThreads = 256;
constexpr int kMoments = 9;
constexpr int kFrameFloats = 24;
constexpr int kCarriedFloats = 12;
constexpr int kBlendThreads = 128;
// Blocks of an SM, where the compiler would take more registers than they allow. On sm_120 shared
// memory holds fewer of `train`, and more of `update` would spill.
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 1200
constexpr int kTrainBlocks = 3, kUpdateBlocks = 2;
#else
constexpr int kTrainBlocks = 5, kUpdateBlocks = 4;
#endif
constexpr float kColorScale = 0.28209479177387814f;  // of the zeroth spherical harmonic
// `Bins::status`: 32-bit numbers, and in the last two one of 64 bits, which nothing can wrap.
enum { kEntriesNeeded = 0, kSlotsNeeded = 1, kOverflow = 2, kOverflows = 3, kSlotsTaken = 4 };
constexpr int kStatusNumbers = 6;
constexpr int kMostEntries = 2147483647;  // a larger need says just this

// A projected Gaussian as the blending wants it: three reads of sixteen bytes. The first and the
// last tile that it may touch, x | y << 16; where it is not drawn the first lies behind the last.
struct alignas(16) Splat {
  float mean_x, mean_y, log2_opacity, qa;
  float qb, qc, depth, red;
  float green, blue;
  uint32_t first_tile, last_tile;

  RGBAVATAR_FUNCTION int first_x() const { return int(first_tile & 0xffff); }
  RGBAVATAR_FUNCTION int first_y() const { return int(first_tile >> 16); }
  RGBAVATAR_FUNCTION int last_x() const { return int(last_tile & 0xffff); }
  RGBAVATAR_FUNCTION int last_y() const { return int(last_tile >> 16); }
  RGBAVATAR_FUNCTION bool drawn() const { return first_x() <= last_x(); }
  RGBAVATAR_FUNCTION int tiles_across() const { return last_x() - first_x() + 1; }
  RGBAVATAR_FUNCTION int tiles() const {
    return drawn() ? tiles_across() * (last_y() - first_y() + 1) : 0;
  }
};
static_assert(sizeof(Splat) == 48, "arguments.h gives a splat twelve floats");

RGBAVATAR_FUNCTION const Splat* splats_of(const Frame& frame, const Bins& bins, int image) {
  return reinterpret_cast<const Splat*>(bins.splats) + int64_t(image) * frame.count;
}

// Copies a splat to shared memory while the thread goes on; it is there for the thread itself after
// finish_copies, for others after a barrier. Turing copies at once.
RGBAVATAR_FUNCTION void begin_copy(Splat& to, const Splat& from) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
  const unsigned at = unsigned(__cvta_generic_to_shared(&to));
  const char* source = reinterpret_cast<const char*>(&from);
#pragma unroll
  for (int k = 0; k < int(sizeof(Splat)); k += 16)
    asm volatile("cp.async.ca.shared.global [%0], [%1], 16;" ::"r"(at + k), "l"(source + k)
                 : "memory");
#else
  to = from;
#endif
}
RGBAVATAR_FUNCTION void finish_copies() {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
  asm volatile("cp.async.wait_all;" ::: "memory");
#endif
}

// The Gaussian's splat; one that is not drawn behind the last Gaussian.
RGBAVATAR_FUNCTION Splat splat_at(const Splat* splats, const Frame& frame, int gaussian) {
  if (gaussian < frame.count) return splats[gaussian];
  Splat none = {};
  none.first_tile = 1u;
  return none;
}

// Log2 of the alpha that a splat has at its best within the rectangle of pixel centres. The best
// point of a rectangle that does not hold the mean lies on a side that faces the mean.
//
// Several kernels ask this of a Gaussian and a tile and must get one answer, or a list would have
// holes: the roundings are written out, so that no compiler fuses other products into sums. The
// quick division is as good, since any point near the best one will do.
RGBAVATAR_FUNCTION float exact_log2_alpha(const Splat& s, float dx, float dy) {
  const float across = __fmaf_rn(dx, s.qa, __fmul_rn(dy, s.qb));
  const float down = __fmaf_rn(dy, __fmul_rn(dy, s.qc), s.log2_opacity);
  return __fmaf_rn(dx, across, down);
}

RGBAVATAR_FUNCTION float best_log2_alpha(const Splat& s, float left, float top, float right,
                                         float bottom) {
  const float low_x = left - s.mean_x, high_x = right - s.mean_x;
  const float low_y = top - s.mean_y, high_y = bottom - s.mean_y;
  const float near_x = fminf(fmaxf(0.0f, low_x), high_x);
  const float near_y = fminf(fmaxf(0.0f, low_y), high_y);
  if (near_x == 0.0f && near_y == 0.0f) return s.log2_opacity;
  const float best_y = __fdividef(__fmul_rn(__fmul_rn(-0.5f, s.qb), near_x), s.qc);
  const float best_x = __fdividef(__fmul_rn(__fmul_rn(-0.5f, s.qb), near_y), s.qa);
  const float on_x = exact_log2_alpha(s, near_x, fminf(fmaxf(best_y, low_y), high_y));
  const float on_y = exact_log2_alpha(s, fminf(fmaxf(best_x, low_x), high_x), near_y);
  return fmaxf(near_x != 0.0f ? on_x : on_y, near_y != 0.0f ? on_y : on_x);
}

// Whether a splat may be seen in the rectangle; the slack is more than rounding makes of a sum of
// products that ends near the cut. Comparisons are such that NaN counts as seen.
RGBAVATAR_FUNCTION bool touches(const Splat& s, float left, float top, float right, float bottom) {
  constexpr float kSlack = 0.05f;
  return !(best_log2_alpha(s, left, top, right, bottom) < C::kLog2MinAlpha - kSlack);
}

RGBAVATAR_FUNCTION bool touches_tile(const Splat& s, const Frame& frame, int tile_x, int tile_y) {
  const float left = float(tile_x * kTileSide) + 0.5f, top = float(tile_y * kTileSide) + 0.5f;
  const float right = fminf(left + (kTileSide - 1.0f), float(frame.width) - 0.5f);
  const float bottom = fminf(top + (kTileSide - 1.0f), float(frame.height) - 0.5f);
  return touches(s, left, top, right, bottom);
}

// Calls visit(place, x, y) with the tiles that the splat touches: the place among the tiles of its
// rectangle, row by row, of which every `step`th is looked at, and the tile.
template <class Visit>
RGBAVATAR_FUNCTION void walk_tiles(const Frame& frame, const Splat& s, int first, int step,
                                   const Visit& visit) {
  if (!s.drawn()) return;
  const int across = s.tiles_across(), count = s.tiles();
  int x = s.first_x() + first % across, y = s.first_y() + first / across;
  for (int place = first; place < count; place += step) {
    if (touches_tile(s, frame, x, y)) visit(place, x, y);
    for (x += step; x > s.last_x(); x -= across) ++y;
  }
}

// A thread walks the tiles of its own splat; a splat of many tiles is walked by the whole warp, so
// that no thread is alone with one that fills the screen.
constexpr int kTilesAlone = 64;

// Calls visit(Gaussian, splat) in all threads of a warp with each that is to be walked by all of
// them. All come here, with consecutive Gaussians; `own` is the thread's, and among `splats` for
// the others.
template <class Visit>
RGBAVATAR_FUNCTION void for_each_shared(const Splat* splats, int gaussian, const Splat& own,
                                        const Visit& visit) {
  const int first = gaussian - (int(threadIdx.x) & 31);
  unsigned left = __ballot_sync(kWholeWarp, own.tiles() > kTilesAlone);
  for (; left; left &= left - 1) {
    const int which = first + __ffs(int(left)) - 1;
    visit(which, splats[which]);
  }
}

// Calls visit(Gaussian, splat, x, y) with every tile that a warp's splats touch, in any order.
template <class Visit>
RGBAVATAR_FUNCTION void for_each_tile(const Frame& frame, const Splat* splats, int gaussian,
                                      const Splat& own, const Visit& visit) {
  const auto walk = [&](int which, const Splat& s, int first, int step) {
    walk_tiles(frame, s, first, step, [&](int, int x, int y) { visit(which, s, x, y); });
  };
  if (own.tiles() <= kTilesAlone) walk(gaussian, own, 0, 1);
  for_each_shared(splats, gaussian, own, [&](int which, const Splat& s) {
    walk(which, s, int(threadIdx.x) & 31, 32);
  });
}

struct alignas(16) Four {
  float x, y, z, w;
};
RGBAVATAR_FUNCTION Four four_at(const float* row) { return *reinterpret_cast<const Four*>(row); }
RGBAVATAR_FUNCTION void put_four(const Four& four, float* row) {
  *reinterpret_cast<Four*>(row) = four;
}

// Copies weights [B, K] to shared memory as [K, B], rows padded to fours with zeros; others see them
// after a barrier. Returns the length of a row.
RGBAVATAR_FUNCTION int load_weights(const float* weights, int batch, int bases, float* to) {
  const int row = (batch + 3) & ~3;
  for (int i = int(threadIdx.x); i < bases * row; i += int(blockDim.x))
    to[i] = i % row < batch ? weights[i % row * bases + i / row] : 0.0f;
  return row;
}

RGBAVATAR_FUNCTION float warp_sum(float value) {
  for (int step = 16; step > 0; step /= 2) value += __shfl_xor_sync(kWholeWarp, value, step);
  return value;
}

// Sums of first sights are whole numbers, which are the same in any order: units of 2^-32.
constexpr int kSightSums = 5;
RGBAVATAR_FUNCTION unsigned long long in_sight_units(float sum) {
  return (unsigned long long)(double(sum) * 4294967296.0);
}

RGBAVATAR_FUNCTION float warp_max(float value) {
  for (int step = 16; step > 0; step /= 2)
    value = fmaxf(value, __shfl_xor_sync(kWholeWarp, value, step));
  return value;
}

// Eight sums over a warp with nine exchanges: each lane gives away the half that it does not keep.
// Lane l returns the sum of v[l / 4].
RGBAVATAR_FUNCTION float warp_sums_of_eight(const float v[8]) {
  const int lane = int(threadIdx.x) & 31;
  float four[4], two[2];
  const bool high = lane & 16, middle = lane & 8, low = lane & 4;
  for (int i = 0; i < 4; ++i) {
    const float given = high ? v[i] : v[i + 4], kept = high ? v[i + 4] : v[i];
    four[i] = kept + __shfl_xor_sync(kWholeWarp, given, 16);
  }
  for (int i = 0; i < 2; ++i) {
    const float given = middle ? four[i] : four[i + 2], kept = middle ? four[i + 2] : four[i];
    two[i] = kept + __shfl_xor_sync(kWholeWarp, given, 8);
  }
  const float given = low ? two[0] : two[1], kept = low ? two[1] : two[0];
  float sum = kept + __shfl_xor_sync(kWholeWarp, given, 4);
  sum += __shfl_xor_sync(kWholeWarp, sum, 2);
  return sum + __shfl_xor_sync(kWholeWarp, sum, 1);
}
