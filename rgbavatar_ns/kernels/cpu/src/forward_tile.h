// Blending of one tile: Gaussian by Gaussian, each over the blocks that it touches.
#pragma once

#include "formulas.h"

namespace rgbavatar::RGBAVATAR_ISA {

// The pixel centres of a tile's blocks.
struct alignas(64) BlockGrid {
  float x[kTileBlocks][kBlockPixels], y[kTileBlocks][kBlockPixels];

  explicit BlockGrid(const Tile& tile) {
    for (int block = 0; block < kTileBlocks; ++block)
      for (int i = 0; i < kBlockPixels; ++i) {
        x[block][i] = float((tile.tile_x * kTileBlocks + block) * kBlockSide + i % kBlockSide) + 0.5f;
        y[block][i] = float((tile.tile_y * kTileBlocks + block) * kBlockSide + i / kBlockSide) + 0.5f;
      }
  }
  // Pixels from a Gaussian's mean.
  RGBAVATAR_MEMBER Wide from_mean_x(const Splat& s, unsigned block) const {
    return load_wide(x[block % kTileBlocks]) - s.mean_x;
  }
  RGBAVATAR_MEMBER Wide from_mean_y(const Splat& s, unsigned block) const {
    return load_wide(y[block / kTileBlocks]) - s.mean_y;
  }
};

// The part of a block that lies in the image.
struct BlockPixels {
  int64_t first;  // index of its first pixel in the image
  int rows, columns;

  BlockPixels(const Tile& tile, int block) {
    const int left = (tile.tile_x * kTileBlocks + block % kTileBlocks) * kBlockSide;
    const int top = (tile.tile_y * kTileBlocks + block / kTileBlocks) * kBlockSide;
    first = int64_t(top) * tile.width + left;
    rows = tile.height - top < kBlockSide ? tile.height - top : kBlockSide;
    columns = tile.width - left < kBlockSide ? tile.width - left : kBlockSide;
  }
  bool whole() const { return rows == kBlockSide && columns == kBlockSide; }

  // Calls visit(lane, pixel index) for each of them.
  template <class Visit>
  void for_each(const Tile& tile, Visit visit) const {
    for (int y = 0; y < rows; ++y)
      for (int x = 0; x < columns; ++x) visit(y * kBlockSide + x, first + y * tile.width + x);
  }
};

// Rows of a block in the scratch memory: transmittance, red, green and blue (or other channels),
// then depth (forward) or remainder (backward).
enum { kTransmittance = 0, kColor = 1, kDepth = 4, kRemainder = 4, kBlendRows = 5 };

template <int kRows>
static RGBAVATAR_MEMBER float (*block_rows(TileScratch& scratch, int block))[kBlockPixels] {
  return scratch.rows + block * kRows;
}

// T is 1 in the image and 0 outside it, so that pixels outside neither take part in the blending
// nor keep their block open. The other rows are 0.
template <int kRows>
static void start_rows(const Tile& tile, TileScratch& scratch) {
  for (int block = 0; block < kBlocksPerTile; ++block) {
    float(*rows)[kBlockPixels] = block_rows<kRows>(scratch, block);
    const BlockPixels pixels(tile, block);
    store(Wide(pixels.whole() ? 1.0f : 0.0f), rows[kTransmittance]);
    if (!pixels.whole())
      pixels.for_each(tile, [&](int lane, int64_t) { rows[kTransmittance][lane] = 1.0f; });
    for (int k = 1; k < kRows; ++k) store(Wide(0.0f), rows[k]);
  }
}

static RGBAVATAR_MEMBER void add_to(float* row, const Wide& value) {
  store(load_wide(row) + value, row);
}

static RGBAVATAR_MEMBER bool is_open(const Wide& transmittance) {
  return any(transmittance >= Wide(C::kMinTransmittance));
}

template <int kRows>
static bool any_open(TileScratch& scratch) {
  for (int block = 0; block < kBlocksPerTile; ++block)
    if (is_open(load_wide(block_rows<kRows>(scratch, block)[kTransmittance]))) return true;
  return false;
}

// ---- Jobs: a Gaussian over a block of pixels ----------------------------------------------------
// A tile's Gaussians are taken in groups, whose jobs stand in one list. A loop over the list has no
// inner loops that end after a few blocks, at places that no processor guesses.

struct Job {
  const Splat* splat;
  unsigned block;

  Job(const Group& group, int i)
      : splat(group.splats + (group.jobs[i] >> 16)), block(group.jobs[i] & 0xffff) {}
};

// Four jobs at a time: a processor does not look far enough ahead to overlap chains of operations as
// long as these by itself.
typedef Floats<4 * kLanes> FourJobs;
template <class Value>
static RGBAVATAR_MEMBER FourJobs of_four(const Job jobs[4], const Value& value) {
  return {{value(jobs[0]), value(jobs[1])}, {value(jobs[2]), value(jobs[3])}};
}
static RGBAVATAR_MEMBER void store_four(const FourJobs& a, float to[4][kBlockPixels]) {
  store(a.low.low, to[0]);
  store(a.low.high, to[1]);
  store(a.high.low, to[2]);
  store(a.high.high, to[3]);
}

// Fills the group's alphas, after cut and cap, and alpha / (1 - alpha) where asked for.
template <bool kWithOdds>
static void fill_alphas(const BlockGrid& grid, Group& group) {
  for (int i = 0; i < 4; ++i) group.jobs[group.job_count + i] = 0;
  for (int i = 0; i < group.job_count; i += 4) {
    const Job jobs[4] = {{group, i}, {group, i + 1}, {group, i + 2}, {group, i + 3}};
    const auto of = [&](auto value) __attribute__((always_inline)) {
      return of_four(jobs, value);
    };
    const FourJobs dx = of([&](const Job& j) { return grid.from_mean_x(*j.splat, j.block); });
    const FourJobs dy = of([&](const Job& j) { return grid.from_mean_y(*j.splat, j.block); });
    const FourJobs p = log2_alpha(dx, dy, of([](const Job& j) { return Wide(j.splat->log2_opacity); }),
                                  of([](const Job& j) { return Wide(j.splat->qa); }),
                                  of([](const Job& j) { return Wide(j.splat->qb); }),
                                  of([](const Job& j) { return Wide(j.splat->qc); }));
    const FourJobs alpha =
        min_of(exp2_where(p >= FourJobs(C::kLog2MinAlpha), p), FourJobs(C::kMaxAlpha));
    store_four(alpha, group.alpha + i);
    if (kWithOdds) store_four(alpha * reciprocal_of(FourJobs(1.0f) - alpha), group.odds + i);
  }
}

// Appends jobs for the blocks of an 8 x 8 window, whose first one is `first` of the tile.
static RGBAVATAR_MEMBER void add_jobs(uint64_t blocks, int first, Group& group) {
  const int code = group.splat_count << 16;
  uint32_t* to = group.jobs + group.job_count;
#if defined(__AVX512F__)
  // Two rows of the window at a time.
  const __m512i pair = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, kTileBlocks, kTileBlocks + 1,
                                         kTileBlocks + 2, kTileBlocks + 3, kTileBlocks + 4,
                                         kTileBlocks + 5, kTileBlocks + 6, kTileBlocks + 7);
  for (int row = 0; row < kWindow; row += 2) {
    if (row == kWindow / 2 && blocks >> (8 * row) == 0) break;  // most end here
    const __mmask16 mask = __mmask16(blocks >> (8 * row));
    const __m512i codes =
        _mm512_add_epi32(pair, _mm512_set1_epi32(code + first + row * kTileBlocks));
    _mm512_storeu_si512(to, _mm512_maskz_compress_epi32(mask, codes));
    to += __builtin_popcount(mask);
  }
#else
  for (; blocks; blocks &= blocks - 1) {
    const int bit = __builtin_ctzll(blocks);
    *to++ = uint32_t(code + first + bit / kWindow * kTileBlocks + bit % kWindow);
  }
#endif
  group.job_count = int(to - group.jobs);
}

// Bits low..high of eight.
static constexpr uint64_t bit_span(int low, int high) {
  const int from = low > 0 ? low : 0, to = high < kWindow - 1 ? high : kWindow - 1;
  return from > to ? 0 : (uint64_t(2) << to) - (uint64_t(1) << from);
}

// The blocks (x, y) of a window with 0 <= left + x < side_x and 0 <= top + y < side_y.
static constexpr uint64_t blocks_within(int left, int top, int side_x, int side_y) {
  const uint64_t rows = bit_span(-top, side_y - 1 - top);
  uint64_t blocks = 0;
  for (int row = 0; row < kWindow; ++row)
    if (rows >> row & 1) blocks |= bit_span(-left, side_x - 1 - left) << (kWindow * row);
  return blocks;
}

// A window's blocks within the tile, by where the window begins.
struct TileClips {
  uint64_t x[kWindow - 1 + kTileBlocks], y[kWindow - 1 + kTileBlocks];

  constexpr TileClips() : x(), y() {
    for (int i = 0; i < kWindow - 1 + kTileBlocks; ++i) {
      const int first = i - (kWindow - 1);
      x[i] = blocks_within(first, 0, kTileBlocks, kWindow);
      y[i] = blocks_within(0, first, kWindow, kTileBlocks);
    }
  }
  uint64_t of(int first_x, int first_y) const {
    return x[first_x + kWindow - 1] & y[first_y + kWindow - 1];
  }
};
static constexpr TileClips kTileClips = {};

// Reads a tile's Gaussians front to back, in groups.
class GroupReader {
 public:
  explicit GroupReader(const Tile& tile)
      : tile_(tile),
        origin_x_(tile.tile_x * kTileBlocks),
        origin_y_(tile.tile_y * kTileBlocks) {}

  // Fills the group with the next Gaussians; false when there are none left.
  bool next(Group& group) {
    constexpr uint32_t kAhead = 16;
    group.splat_count = group.job_count = 0;
    while (entry_ < tile_.entry_count && group.splat_count < kGroupSplats &&
           group.job_count <= kGroupJobs - kWindow * kWindow) {
      if (entry_ + kAhead < tile_.entry_count)
        __builtin_prefetch(tile_.splats + tile_.entries[entry_ + kAhead].gaussian);
      const Entry entry = tile_.entries[entry_];
      const Splat& s = tile_.splats[entry.gaussian];
      if (s.blocks == kAllBlocks) {
        add_window(s, entry.slot, group);
        continue;
      }
      const int x = s.bounds.first_block_x - origin_x_, y = s.bounds.first_block_y - origin_y_;
      add(s, entry.slot, false, s.blocks & kTileClips.of(x, y), y * kTileBlocks + x, group);
      ++entry_;
    }
    return group.splat_count > 0;
  }

  // Calls visit(slot) for the Gaussians that no group has begun with.
  template <class Visit>
  void rest(const Visit& visit) const {
    for (uint32_t i = entry_ + (window_ > 0); i < tile_.entry_count; ++i)
      visit(tile_.entries[i].slot);
  }

 private:
  static RGBAVATAR_MEMBER void add(const Splat& s, uint32_t slot, bool continued, uint64_t blocks,
                                   int first_block, Group& group) {
    const int place = group.splat_count;
    group.splats[place] = s;
    group.slot[place] = slot;
    group.continued[place] = continued;
    group.first_job[place] = uint32_t(group.job_count);
    add_jobs(blocks, first_block, group);
    group.first_job[++group.splat_count] = uint32_t(group.job_count);
  }

  // One window of a Gaussian that needs several.
  __attribute__((noinline)) void add_window(const Splat& s, uint32_t slot, Group& group) {
    const int last_x = s.bounds.last_block_x - origin_x_;
    const int last_y = s.bounds.last_block_y - origin_y_;
    const int side_x = last_x < kTileBlocks ? last_x + 1 : kTileBlocks;
    const int side_y = last_y < kTileBlocks ? last_y + 1 : kTileBlocks;
    const int first_x = s.bounds.first_block_x > origin_x_ ? s.bounds.first_block_x - origin_x_ : 0;
    const int first_y = s.bounds.first_block_y > origin_y_ ? s.bounds.first_block_y - origin_y_ : 0;
    const int across = (side_x - first_x + kWindow - 1) / kWindow;
    const int down = (side_y - first_y + kWindow - 1) / kWindow;
    const int x = first_x + window_ % across * kWindow, y = first_y + window_ / across * kWindow;
    add(s, slot, window_ > 0, blocks_within(x, y, side_x, side_y), y * kTileBlocks + x, group);
    if (++window_ < across * down) return;
    window_ = 0;
    ++entry_;
  }

  const Tile& tile_;
  int origin_x_, origin_y_;
  uint32_t entry_ = 0;
  int window_ = 0;  // the next one of the present Gaussian, where it needs several
};

template <int kRows, bool kWithDepth>
static void blend_group(const Group& group, TileScratch& scratch) {
  for (int i = 0; i < group.job_count; ++i) {
    const Job job(group, i);
    float* row = block_rows<kRows>(scratch, job.block)[0];
    const Wide t = load_wide(row);
    if (!is_open(t)) continue;
    const Splat& s = *job.splat;
    const Wide w = load_wide(group.alpha[i]) * t;
    store(t - w, row);
    add_to(row + kColor * kBlockPixels, w * s.red);
    add_to(row + (kColor + 1) * kBlockPixels, w * s.green);
    add_to(row + (kColor + 2) * kBlockPixels, w * s.blue);
    if (kWithDepth) add_to(row + kDepth * kBlockPixels, w * s.depth);
  }
}

// Puts the background behind the block and writes it to the image.
template <int kRows>
static void write_block(const Tile& tile, const ForwardOutput& out, int block,
                        TileScratch& scratch) {
  float(*rows)[kBlockPixels] = block_rows<kRows>(scratch, block);
  const float* transmittance = rows[kTransmittance];
  float(*channels)[kBlockPixels] = rows + kColor;
  const Wide t = load_wide(transmittance);
  for (int k = 0; k < 3; ++k)
    store(load_wide(channels[k]) + t * out.background[k], channels[k]);
  const BlockPixels pixels(tile, block);
  if (pixels.whole()) {
    for (int y = 0; y < kBlockSide; ++y) {
      const int lane = y * kBlockSide;
      const int64_t pixel = pixels.first + y * tile.width;
      store_interleaved(load_quad(channels[0] + lane), load_quad(channels[1] + lane),
                        load_quad(channels[2] + lane), out.image + pixel * 3);
      store_quad(1.0f - load_quad(transmittance + lane), out.alpha + pixel);
    }
  } else {
    pixels.for_each(tile, [&](int lane, int64_t pixel) {
      for (int k = 0; k < 3; ++k) out.image[pixel * 3 + k] = channels[k][lane];
      out.alpha[pixel] = 1.0f - transmittance[lane];
    });
  }
  if (kRows <= kDepth) return;
  pixels.for_each(tile, [&](int lane, int64_t pixel) {
    const float alpha = 1.0f - transmittance[lane];
    out.depth[pixel] = alpha > 0.0f ? rows[kDepth][lane] / alpha : 0.0f;
  });
}

template <bool kWithDepth>
static void forward_rows(const Tile& tile, const ForwardOutput& out, TileScratch& scratch) {
  constexpr int kRows = kWithDepth ? kDepth + 1 : kDepth;
  const BlockGrid grid(tile);
  GroupReader reader(tile);
  Group& group = scratch.groups[0];
  start_rows<kRows>(tile, scratch);
  while (any_open<kRows>(scratch) && reader.next(group)) {
    fill_alphas<false>(grid, group);
    blend_group<kRows, kWithDepth>(group, scratch);
  }
  for (int block = 0; block < kBlocksPerTile; ++block)
    write_block<kRows>(tile, out, block, scratch);
}

static void forward_tile(const Tile& tile, const ForwardOutput& out, TileScratch& scratch) {
  if (out.depth)
    forward_rows<true>(tile, out, scratch);
  else
    forward_rows<false>(tile, out, scratch);
}

}  // namespace rgbavatar::RGBAVATAR_ISA
