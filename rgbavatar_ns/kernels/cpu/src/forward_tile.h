// Blending of one tile: block by block, the block's Gaussians from front to back.
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
// then depth (forward) or what is behind (backward).
enum { kTransmittance = 0, kColor = 1, kDepth = 4, kBehind = 4, kBlendRows = 5 };

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

static RGBAVATAR_MEMBER bool is_open(const Wide& transmittance) {
  return any(transmittance >= Wide(C::kMinTransmittance));
}

// The blocks with pixels that let light through.
template <int kRows>
static uint64_t open_blocks(TileScratch& scratch) {
  uint64_t open = 0;
  for (int block = 0; block < kBlocksPerTile; ++block)
    if (is_open(load_wide(block_rows<kRows>(scratch, block)[kTransmittance])))
      open |= uint64_t(1) << block;
  return open;
}

// ---- Groups: Gaussians of a tile that are taken together ----------------------------------------
// A group is a 64 x 64 matrix of bits: which of its Gaussians touches which block of the tile. A job
// is a bit that is set. Jobs of one block are blended in a row, with the block's pixels in registers;
// sums over pixels take the jobs of one Gaussian in a row.

// Bits low..high of eight.
static constexpr uint64_t bit_span(int low, int high) {
  const int from = low > 0 ? low : 0, to = high < kTileBlocks - 1 ? high : kTileBlocks - 1;
  return from > to ? 0 : (uint64_t(2) << to) - (uint64_t(1) << from);
}

// Bits of the blocks (x, y) of a window of 8 x 8 with first_x <= x <= last_x, first_y <= y <= last_y.
static constexpr uint64_t blocks_within(int first_x, int first_y, int last_x, int last_y) {
  const uint64_t rows = bit_span(first_y, last_y), row = bit_span(first_x, last_x);
  uint64_t blocks = 0;
  for (int y = 0; y < kTileBlocks; ++y)
    if (rows >> y & 1) blocks |= row << (kTileBlocks * y);
  return blocks;
}

// A window's blocks within the tile, by where the window begins.
struct TileClips {
  uint64_t x[2 * kTileBlocks - 1], y[2 * kTileBlocks - 1];

  constexpr TileClips() : x(), y() {
    for (int i = 0; i < 2 * kTileBlocks - 1; ++i) {
      const int first = i - (kTileBlocks - 1);
      x[i] = blocks_within(-first, 0, kTileBlocks - 1 - first, kTileBlocks - 1);
      y[i] = blocks_within(0, -first, kTileBlocks - 1, kTileBlocks - 1 - first);
    }
  }
  uint64_t of(int first_x, int first_y) const {
    return x[first_x + kTileBlocks - 1] & y[first_y + kTileBlocks - 1];
  }
};
static constexpr TileClips kTileClips = {};

static inline uint64_t rotated_left(uint64_t bits, unsigned by) {
  return bits << (by & 63) | bits >> (-by & 63);
}

// The blocks of a tile that a Gaussian touches; the tile's first block is (origin_x, origin_y).
static RGBAVATAR_MEMBER uint64_t blocks_of_tile(const Splat& s, int origin_x, int origin_y) {
  const int x = s.bounds.first_block_x - origin_x, y = s.bounds.first_block_y - origin_y;
  if (__builtin_expect(s.blocks == kAllBlocks, false))
    return blocks_within(x, y, s.bounds.last_block_x - origin_x, s.bounds.last_block_y - origin_y);
  return rotated_left(s.blocks & kTileClips.of(x, y), unsigned(y * kTileBlocks + x));
}

// Rows become columns.
template <int kHalf>
static RGBAVATAR_MEMBER void transpose_bits_by(uint64_t* bits, uint64_t mask) {
  for (int block = 0; block < 64; block += 2 * kHalf)
    for (int i = block; i < block + kHalf; ++i) {
      const uint64_t swapped = (bits[i] >> kHalf ^ bits[i + kHalf]) & mask;
      bits[i + kHalf] ^= swapped;
      bits[i] ^= swapped << kHalf;
    }
}
static void transpose_bits(uint64_t bits[64]) {
  transpose_bits_by<32>(bits, 0x00000000ffffffffu);
  transpose_bits_by<16>(bits, 0x0000ffff0000ffffu);
  transpose_bits_by<8>(bits, 0x00ff00ff00ff00ffu);
  transpose_bits_by<4>(bits, 0x0f0f0f0f0f0f0f0fu);
  transpose_bits_by<2>(bits, 0x3333333333333333u);
  transpose_bits_by<1>(bits, 0x5555555555555555u);
}

// Reads a tile's Gaussians front to back, in groups.
class GroupReader {
 public:
  explicit GroupReader(const Tile& tile)
      : tile_(tile),
        origin_x_(tile.tile_x * kTileBlocks),
        origin_y_(tile.tile_y * kTileBlocks) {}

  // Fills the group with the next Gaussians that touch open blocks, with at most `room` jobs; false
  // when there are none left. Calls skip(splat) for those before them that touch none.
  template <class Skip>
  bool next(Group& group, uint64_t open, int room, const Skip& skip) {
    constexpr uint32_t kAhead = 16;
    int count = 0, jobs = 0;
    for (; entry_ < tile_.entry_count && count < kGroupSplats && jobs <= room - kBlocksPerTile;
         ++entry_) {
      if (entry_ + kAhead < tile_.entry_count)
        __builtin_prefetch(tile_.splats + uint32_t(tile_.entries[entry_ + kAhead]));
      const Splat& s = tile_.splats[uint32_t(tile_.entries[entry_])];
      const uint64_t blocks = blocks_of_tile(s, origin_x_, origin_y_) & open;
      if (!blocks) {
        skip(s);
        continue;
      }
      group.splats[count] = s;
      group.blocks[count] = blocks;
      group.first_job[count] = jobs;
      jobs += __builtin_popcountll(blocks);
      ++count;
    }
    group.count = count;
    group.jobs = jobs;
    for (int i = 0; i < count; ++i) group.touching[i] = group.blocks[i];
    for (int i = count; i < kGroupSplats; ++i) group.touching[i] = 0;
    transpose_bits(group.touching);
    return count > 0;
  }
  // Calls skip(splat) for all that were not read.
  template <class Skip>
  void rest(const Skip& skip) const {
    for (uint32_t i = entry_; i < tile_.entry_count; ++i)
      skip(tile_.splats[uint32_t(tile_.entries[i])]);
  }

  bool more() const { return entry_ < tile_.entry_count; }
  uint32_t entry() const { return entry_; }
  void go_to(uint32_t entry) { entry_ = entry; }

 private:
  const Tile& tile_;
  int origin_x_, origin_y_;
  uint32_t entry_ = 0;
};

static RGBAVATAR_MEMBER Wide alpha_of(const Wide& x, const Wide& y, const Splat& s) {
  const Wide dx = x - s.mean_x, dy = y - s.mean_y;
  const Wide p = log2_alpha(dx, dy, Wide(s.log2_opacity), Wide(s.qa), Wide(s.qb), Wide(s.qc));
  return min_of(exp2_where(p >= Wide(C::kLog2MinAlpha), p), Wide(C::kMaxAlpha));
}

// Blends a group's jobs over a block; false when this closed it.
template <int kRows, bool kColors, bool kWithDepth, bool kKeep>
static RGBAVATAR_MEMBER bool blend_block(const BlockGrid& grid, const Group& group, int block,
                                         float (*rows)[kBlockPixels], const Kept& kept) {
  const Wide x = load_wide(grid.x[block % kTileBlocks]), y = load_wide(grid.y[block / kTileBlocks]);
  const uint64_t below = (uint64_t(1) << block) - 1;
  Wide t = load_wide(rows[kTransmittance]), red, green, blue, depth;
  if (kColors) {
    red = load_wide(rows[kColor]), green = load_wide(rows[kColor + 1]);
    blue = load_wide(rows[kColor + 2]);
  }
  if (kWithDepth) depth = load_wide(rows[kDepth]);
  bool open = true;
  for (uint64_t left = group.touching[block]; left; left &= left - 1) {
    const int i = __builtin_ctzll(left);
    const Splat& s = group.splats[i];
    const size_t job =
        kKeep ? group.first_job[i] + __builtin_popcountll(group.blocks[i] & below) : 0;
    if (__builtin_expect(!open, false)) {
      if (!kKeep) break;
      store(Wide(0.0f), kept.alpha[job]);
      store(Wide(0.0f), kept.weight[job]);
      continue;
    }
    const Wide alpha = alpha_of(x, y, s);
    const Wide w = alpha * t;
    t = t - w;
    if (kColors) {
      red = red + w * s.red;
      green = green + w * s.green;
      blue = blue + w * s.blue;
    }
    if (kWithDepth) depth = depth + w * s.depth;
    if (kKeep) {
      store(alpha, kept.alpha[job]);
      store(w, kept.weight[job]);
    }
    open = is_open(t);
  }
  store(t, rows[kTransmittance]);
  if (kColors) {
    store(red, rows[kColor]);
    store(green, rows[kColor + 1]);
    store(blue, rows[kColor + 2]);
  }
  if (kWithDepth) store(depth, rows[kDepth]);
  return open;
}

// Blends a group over the tile; returns the blocks that it closed.
template <int kRows, bool kColors, bool kWithDepth, bool kKeep>
static uint64_t blend_group(const BlockGrid& grid, const Group& group, TileScratch& scratch,
                            const Kept& kept) {
  uint64_t closed = 0;
  for (int block = 0; block < kBlocksPerTile; ++block)
    if (group.touching[block] &&
        !blend_block<kRows, kColors, kWithDepth, kKeep>(grid, group, block,
                                                        block_rows<kRows>(scratch, block), kept))
      closed |= uint64_t(1) << block;
  return closed;
}

// ---- Keeping what sums over pixels need ---------------------------------------------------------

static RGBAVATAR_MEMBER Kept kept_from(TileScratch& scratch, int first) {
  return {scratch.alpha + first, scratch.weight + first};
}

// Blends a tile and keeps its groups with their jobs' alphas and weights, so that they can be visited
// again from back to front. Groups that there is no room for are made again: of those, only where
// they begin and the transmittance there is kept.
template <int kRows>
class KeptGroups {
 public:
  // Calls skip(splat) for the Gaussians that are in no group.
  template <bool kColors, class Skip>
  void blend(const Tile& tile, const BlockGrid& grid, TileScratch& scratch, const Skip& skip) {
    GroupReader reader(tile);
    uint64_t open = open_blocks<kRows>(scratch);
    int jobs = 0;
    while (open && kept_ < kKeptGroups && jobs <= kKeptJobs - kBlocksPerTile) {
      Group& group = scratch.groups[kept_];
      if (!reader.next(group, open, kKeptJobs - jobs, skip)) break;
      group.kept_from = jobs;
      open &= ~blend_group<kRows, kColors, false, true>(grid, group, scratch,
                                                        kept_from(scratch, jobs));
      jobs += group.jobs;
      ++kept_;
    }
    Group& group = scratch.groups[kKeptGroups];
    while (open && reader.more()) {
      Checkpoint& checkpoint = scratch.checkpoints[remade_];
      save(reader, scratch, checkpoint);
      if (!reader.next(group, open, kNoLimit, skip)) break;
      open &= ~blend_group<kRows, kColors, false, false>(grid, group, scratch, {});
      ++remade_;
    }
    reader.rest(skip);
  }

  // Calls visit(group, kept alphas and weights) from the last group to the first; the tile's
  // transmittance is lost.
  template <class Visit>
  void visit_back_to_front(const Tile& tile, const BlockGrid& grid, TileScratch& scratch,
                           const Visit& visit) const {
    const Kept spare = kept_from(scratch, kKeptJobs);
    for (int i = remade_; i-- > 0;) {
      GroupReader reader(tile);
      restore(reader, scratch, scratch.checkpoints[i]);
      Group& group = scratch.groups[kKeptGroups];
      reader.next(group, open_blocks<kRows>(scratch), kNoLimit, [](const Splat&) {});
      blend_group<kRows, false, false, true>(grid, group, scratch, spare);
      visit(group, spare);
    }
    for (int i = kept_; i-- > 0;) {
      const Group& group = scratch.groups[i];
      visit(group, kept_from(scratch, group.kept_from));
    }
  }

 private:
  static void save(const GroupReader& reader, TileScratch& scratch, Checkpoint& to) {
    to.entry = reader.entry();
    for (int block = 0; block < kBlocksPerTile; ++block)
      store(load_wide(block_rows<kRows>(scratch, block)[kTransmittance]), to.transmittance[block]);
  }
  static void restore(GroupReader& reader, TileScratch& scratch, const Checkpoint& from) {
    reader.go_to(from.entry);
    for (int block = 0; block < kBlocksPerTile; ++block)
      store(load_wide(from.transmittance[block]), block_rows<kRows>(scratch, block)[kTransmittance]);
  }

  int kept_ = 0, remade_ = 0;
};

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

// The background alone, where no Gaussian is.
static void write_background(const Tile& tile, const ForwardOutput& out) {
  constexpr int kTileSide = kTileBlocks * kBlockSide;
  const int left = tile.tile_x * kTileSide, top = tile.tile_y * kTileSide;
  const int columns = tile.width - left < kTileSide ? tile.width - left : kTileSide;
  const int bottom = tile.height - top < kTileSide ? tile.height : top + kTileSide;
  float colors[kTileSide * 3];
  for (int i = 0; i < kTileSide * 3; ++i) colors[i] = out.background[i % 3];
  for (int y = top; y < bottom; ++y) {
    const int64_t pixel = int64_t(y) * tile.width + left;
    __builtin_memcpy(out.image + pixel * 3, colors, columns * 3 * sizeof(float));
    __builtin_memset(out.alpha + pixel, 0, columns * sizeof(float));
    if (out.depth) __builtin_memset(out.depth + pixel, 0, columns * sizeof(float));
  }
}

template <bool kWithDepth>
static void forward_rows(const Tile& tile, const ForwardOutput& out, TileScratch& scratch) {
  constexpr int kRows = kWithDepth ? kDepth + 1 : kDepth;
  const BlockGrid grid(tile);
  GroupReader reader(tile);
  Group& group = scratch.groups[0];
  start_rows<kRows>(tile, scratch);
  uint64_t open = open_blocks<kRows>(scratch);
  while (open && reader.next(group, open, kNoLimit, [](const Splat&) {}))
    open &= ~blend_group<kRows, true, kWithDepth, false>(grid, group, scratch, {});
  for (int block = 0; block < kBlocksPerTile; ++block)
    write_block<kRows>(tile, out, block, scratch);
}

static void forward_tile(const Tile& tile, const ForwardOutput& out, TileScratch& scratch) {
  if (tile.entry_count == 0)
    write_background(tile, out);
  else if (out.depth)
    forward_rows<true>(tile, out, scratch);
  else
    forward_rows<false>(tile, out, scratch);
}

}  // namespace rgbavatar::RGBAVATAR_ISA
