// Blending of one tile: block by block, every block through its list of Gaussians.
#pragma once

#include "formulas.h"

namespace rgbavatar::RGBAVATAR_ISA {

struct BlockRange {
  int first_x, last_x, first_y, last_y;  // within the tile, inclusive
};

static inline BlockRange blocks_in_tile(const Bounds& s, int origin_x, int origin_y) {
  const int x0 = s.first_block_x - origin_x, x1 = s.last_block_x - origin_x;
  const int y0 = s.first_block_y - origin_y, y1 = s.last_block_y - origin_y;
  return {x0 > 0 ? x0 : 0, x1 < kTileBlocks ? x1 : kTileBlocks - 1, y0 > 0 ? y0 : 0,
          y1 < kTileBlocks ? y1 : kTileBlocks - 1};
}

// Centres of a block's pixels.
struct PixelCentres {
  Wide x, y;
  PixelCentres() {
    float lane_x[kBlockPixels], lane_y[kBlockPixels];
    for (int i = 0; i < kBlockPixels; ++i) {
      lane_x[i] = i % kBlockSide + 0.5f;
      lane_y[i] = i / kBlockSide + 0.5f;
    }
    load(x, lane_x);
    load(y, lane_y);
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

// Copies the tile's next Gaussians, which lie far apart, to scratch.portion.
static int load_portion(const Tile& tile, uint32_t first, TileScratch& scratch) {
  constexpr uint32_t kAhead = 12;
  const uint32_t rest = tile.entry_count - first;
  const uint32_t count = rest < uint32_t(kPortion) ? rest : kPortion;
  const uint32_t* entries = tile.entries + first;
  for (uint32_t i = 0; i < kAhead && i < count; ++i) __builtin_prefetch(&tile.splats[entries[i]]);
  for (uint32_t i = 0; i < count; ++i) {
    if (i + kAhead < count) __builtin_prefetch(&tile.splats[entries[i + kAhead]]);
    scratch.portion[i] = tile.splats[entries[i]];
  }
  return int(count);
}

// Which of the portion's Gaussians touch each block, as scratch.list.
static void list_by_block(const Tile& tile, int count, TileScratch& scratch) {
  const int origin_x = tile.tile_x * kTileBlocks, origin_y = tile.tile_y * kTileBlocks;
  for (int block = 0; block < kBlocksPerTile; ++block) scratch.list_size[block] = 0;
  for (int i = 0; i < count; ++i) {
    const BlockRange r = blocks_in_tile(scratch.portion[i].bounds, origin_x, origin_y);
    for (int y = r.first_y; y <= r.last_y; ++y)
      for (int x = r.first_x; x <= r.last_x; ++x) {
        const int block = y * kTileBlocks + x;
        scratch.list[block][scratch.list_size[block]++] = uint16_t(i);
      }
  }
}

struct Alpha {
  Wide raw, value;  // before the cap, and as blended; both 0 below the cut
};

static RGBAVATAR_MEMBER Alpha alpha_at(const Wide& dx, const Wide& dy, const Splat& s) {
  const Wide p = log2_alpha(dx, dy, s.log2_opacity, s.qa, s.qb, s.qc);
  const Wide raw = select(p >= Wide(C::kLog2MinAlpha), exp2_of(p), Wide(0.0f));
  return {raw, min_of(raw, Wide(C::kMaxAlpha))};
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

// Blends a block's list into its rows.
template <bool kWithDepth>
static inline void blend_block(const Tile& tile, const PixelCentres& centres, int block,
                               TileScratch& scratch) {
  const Wide px = centres.x + float((tile.tile_x * kTileBlocks + block % kTileBlocks) * kBlockSide);
  const Wide py = centres.y + float((tile.tile_y * kTileBlocks + block / kTileBlocks) * kBlockSide);
  float(*rows)[kBlockPixels] = block_rows<kBlendRows>(scratch, block);
  Wide t = load_wide(rows[kTransmittance]), red = load_wide(rows[kColor]);
  Wide green = load_wide(rows[kColor + 1]), blue = load_wide(rows[kColor + 2]);
  Wide depth = load_wide(rows[kDepth]);
  const int size = scratch.list_size[block];
  for (int i = 0; i < size && is_open(t); ++i) {
    const Splat& s = scratch.portion[scratch.list[block][i]];
    const Wide w = alpha_at(px - s.mean_x, py - s.mean_y, s).value * t;
    red = red + w * s.red;
    green = green + w * s.green;
    blue = blue + w * s.blue;
    if (kWithDepth) depth = depth + w * s.depth;
    t = t - w;
  }
  store(t, rows[kTransmittance]);
  store(red, rows[kColor]);
  store(green, rows[kColor + 1]);
  store(blue, rows[kColor + 2]);
  if (kWithDepth) store(depth, rows[kDepth]);
}

// Puts the background behind the block and writes it to the image.
static void write_block(const Tile& tile, const ForwardOutput& out, int block,
                        TileScratch& scratch) {
  float(*rows)[kBlockPixels] = block_rows<kBlendRows>(scratch, block);
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
  if (!out.depth) return;
  pixels.for_each(tile, [&](int lane, int64_t pixel) {
    const float alpha = 1.0f - transmittance[lane];
    out.depth[pixel] = alpha > 0.0f ? rows[kDepth][lane] / alpha : 0.0f;
  });
}

static void forward_tile(const Tile& tile, const ForwardOutput& out, TileScratch& scratch) {
  const PixelCentres centres;
  start_rows<kBlendRows>(tile, scratch);
  for (uint32_t first = 0; first < tile.entry_count; first += kPortion) {
    if (first && !any_open<kBlendRows>(scratch)) break;
    list_by_block(tile, load_portion(tile, first, scratch), scratch);
    for (int block = 0; block < kBlocksPerTile; ++block) {
      if (scratch.list_size[block] == 0) continue;
      if (out.depth)
        blend_block<true>(tile, centres, block, scratch);
      else
        blend_block<false>(tile, centres, block, scratch);
    }
  }
  for (int block = 0; block < kBlocksPerTile; ++block) write_block(tile, out, block, scratch);
}

}  // namespace rgbavatar::RGBAVATAR_ISA
