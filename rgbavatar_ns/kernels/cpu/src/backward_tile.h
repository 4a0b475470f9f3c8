// Passes that sum over pixels for each Gaussian of a tile: gradients and weighted averages.
#pragma once

#include "forward_tile.h"

namespace rgbavatar::RGBAVATAR_ISA {

static void load_color_block(const Tile& tile, const float* image, const BlockPixels& pixels,
                             float channels[3][kBlockPixels]) {
  if (pixels.whole()) {
    for (int y = 0; y < kBlockSide; ++y) {
      Quad r, g, b;
      load_interleaved(image + (pixels.first + y * tile.width) * 3, r, g, b);
      store_quad(r, channels[0] + y * kBlockSide);
      store_quad(g, channels[1] + y * kBlockSide);
      store_quad(b, channels[2] + y * kBlockSide);
    }
  } else {
    for (int k = 0; k < 3; ++k) store(Wide(0.0f), channels[k]);
    pixels.for_each(tile, [&](int lane, int64_t pixel) {
      for (int k = 0; k < 3; ++k) channels[k][lane] = image[pixel * 3 + k];
    });
  }
}

// Begins to fetch the block two below, whose rows lie too far apart for the processor to guess.
static void prefetch_block(const Tile& tile, const float* image, const BlockPixels& pixels) {
  for (int y = 0; y < kBlockSide; ++y)
    __builtin_prefetch(image + (pixels.first + (2 * kBlockSide + y) * int64_t(tile.width)) * 3);
}

// Sets the channels to g = dL/dimage and `behind` to g . background - dL/dalpha; all are 0 outside
// the image.
static void start_gradient(const Tile& tile, const BackwardInput& in, TileScratch& scratch) {
  for (int block = 0; block < kBlocksPerTile; ++block) {
    float(*rows)[kBlockPixels] = block_rows<kBlendRows>(scratch, block);
    float(*g)[kBlockPixels] = rows + kColor;
    const BlockPixels pixels(tile, block);
    Wide behind(0.0f);
    if (in.image_grad) {
      prefetch_block(tile, in.image_grad, pixels);
      load_color_block(tile, in.image_grad, pixels, g);
      for (int k = 0; k < 3; ++k) behind = behind + load_wide(g[k]) * in.background[k];
    } else {
      for (int k = 0; k < 3; ++k) store(Wide(0.0f), g[k]);
    }
    store(behind, rows[kBehind]);
    if (in.alpha_grad)
      pixels.for_each(tile, [&](int lane, int64_t pixel) {
        rows[kBehind][lane] -= in.alpha_grad[pixel];
      });
  }
}

// Where a Gaussian's sums over a tile go.
static RGBAVATAR_MEMBER float* slot_of(const Tile& tile, const Splat& s, float* slots, int width) {
  const int first_x = s.bounds.first_block_x >> kTileBlocksShift;
  const int first_y = s.bounds.first_block_y >> kTileBlocksShift;
  const int across = (s.bounds.last_block_x >> kTileBlocksShift) - first_x + 1;
  const int place = (tile.tile_y - first_y) * across + tile.tile_x - first_x;
  return slots + (int64_t(s.first_slot) + place) * width;
}

static void clear_slot(const Tile& tile, const Splat& s, float* slots, int width) {
  float* slot = slot_of(tile, s, slots, width);
  for (int k = 0; k < width; ++k) slot[k] = 0.0f;
}

// Where pixel (0, 0) of a block is, from that of the tile's first block.
struct BlockOffsets {
  float x[kBlocksPerTile], y[kBlocksPerTile];
  constexpr BlockOffsets() : x(), y() {
    for (int block = 0; block < kBlocksPerTile; ++block) {
      x[block] = float(block % kTileBlocks * kBlockSide);
      y[block] = float(block / kTileBlocks * kBlockSide);
    }
  }
};
static constexpr BlockOffsets kBlockOffsets = {};

// Sums over a Gaussian's jobs, lane by lane: of w dL/dcolour, of alpha dL/dalpha, and of this times
// dx, dy and their products.
struct LaneSums {
  Native red = 0.0f, green = 0.0f, blue = 0.0f, one = 0.0f, x = 0.0f, y = 0.0f, xx = 0.0f,
         xy = 0.0f, yy = 0.0f, largest = 0.0f;

  void add(const LaneSums& other) {
    red = red + other.red, green = green + other.green, blue = blue + other.blue;
    one = one + other.one, x = x + other.x, y = y + other.y;
    xx = xx + other.xx, xy = xy + other.xy, yy = yy + other.yy;
    largest = max_of(largest, other.largest);
  }
};

static RGBAVATAR_MEMBER Native load_native(const float* from) {
  Native a;
  load(a, from);
  return a;
}

// The sums of a register's lanes from `first` on. Afterwards the Gaussian stands, for these pixels,
// behind those in front of it.
template <bool kLargest>
static RGBAVATAR_MEMBER LaneSums sum_lanes(const BlockGrid& grid, const Group& group, int place,
                                           int first, const Kept& kept, TileScratch& scratch) {
  const Splat& s = group.splats[place];
  const Native color_red(s.red), color_green(s.green), color_blue(s.blue), zero(0.0f);
  const Native x = load_native(grid.x[0] + first) - s.mean_x;
  const Native y = load_native(grid.y[0] + first) - s.mean_y;
  LaneSums sums;
  const float* alpha_row = kept.alpha[group.first_job[place]] + first;
  const float* weight_row = kept.weight[group.first_job[place]] + first;
  for (uint64_t left = group.blocks[place]; left; left &= left - 1) {
    const int block = __builtin_ctzll(left);
    float* row = block_rows<kBlendRows>(scratch, block)[0] + first;
    const Native red = load_native(row + kColor * kBlockPixels);
    const Native green = load_native(row + (kColor + 1) * kBlockPixels);
    const Native blue = load_native(row + (kColor + 2) * kBlockPixels);
    const Native behind = load_native(row + kBehind * kBlockPixels);
    const Native alpha = load_native(alpha_row), w = load_native(weight_row);
    if (kLargest) sums.largest = max_of(sums.largest, w);
    const Native more = red * color_red + green * color_green + blue * color_blue - behind;
    store(behind + alpha * more, row + kBehind * kBlockPixels);
    // alpha dL/dalpha, whose ln 2 follows below; the cap has no gradient.
    const Native d_p = select(Native(C::kMaxAlpha) > alpha, w * more, zero);
    const Native dx = x + kBlockOffsets.x[block], dy = y + kBlockOffsets.y[block];
    const Native d_x = d_p * dx, d_y = d_p * dy;
    sums.red = sums.red + w * red;
    sums.green = sums.green + w * green;
    sums.blue = sums.blue + w * blue;
    sums.one = sums.one + d_p;
    sums.x = sums.x + d_x;
    sums.y = sums.y + d_y;
    sums.xx = sums.xx + d_x * dx;
    sums.xy = sums.xy + d_x * dy;
    sums.yy = sums.yy + d_y * dy;
    alpha_row += kBlockPixels;
    weight_row += kBlockPixels;
  }
  return sums;
}

// The sums over the jobs of one Gaussian of the group, which are written to its slot. Returns the
// largest weight, if that is asked for. The sums of a register's lanes are taken over all jobs before
// the next lanes are: those of a whole block would not stay in AVX2's registers, or SSE's.
template <bool kLargest>
static RGBAVATAR_MEMBER float sum_moments(const Tile& tile, const BlockGrid& grid,
                                          const Group& group, int place, const Kept& kept,
                                          TileScratch& scratch, float* slots) {
  LaneSums sums = sum_lanes<kLargest>(grid, group, place, 0, kept, scratch);
  for (int first = kNativeLanes; first < kLanes; first += kNativeLanes)
    sums.add(sum_lanes<kLargest>(grid, group, place, first, kept, scratch));
  float* slot = slot_of(tile, group.splats[place], slots, kMoments);
  const Quad units = {1.0f, 1.0f, 1.0f, C::kLn2};
  store_quad(sums_of(sums.red, sums.green, sums.blue, sums.one) * units, slot);
  store_quad(sums_of(sums.x, sums.y, sums.xx, sums.xy) * C::kLn2, slot + 4);
  slot[8] = sum_of(sums.yy) * C::kLn2;
  return kLargest ? max_lane(sums.largest) : 0.0f;
}

static void sum_group(const Tile& tile, const BlockGrid& grid, const Group& group, const Kept& kept,
                      TileScratch& scratch, float* slots) {
  for (int i = group.count; i-- > 0;)
    sum_moments<false>(tile, grid, group, i, kept, scratch, slots);
}

static void backward_tile(const Tile& tile, const BackwardInput& in, TileScratch& scratch,
                          float* slots) {
  const BlockGrid grid(tile);
  KeptGroups<kBlendRows> groups;
  start_rows<kBlendRows>(tile, scratch);
  groups.template blend<false>(tile, grid, scratch,
                      [&](const Splat& s) { clear_slot(tile, s, slots, kMoments); });
  start_gradient(tile, in, scratch);
  groups.visit_back_to_front(tile, grid, scratch, [&](const Group& group, const Kept& kept) {
    sum_group(tile, grid, group, kept, scratch, slots);
  });
}

template <int kChannels>
static RGBAVATAR_MEMBER void sum_channels(const Tile& tile, const Group& group, int place,
                                          const Kept& kept, int channels, TileScratch& scratch,
                                          float* slots) {
  Wide sums[kChannels + 1], largest(0.0f);
  for (int k = 0; k <= kChannels; ++k) sums[k] = Wide(0.0f);
  const float* weight_row = kept.weight[group.first_job[place]];
  for (uint64_t left = group.blocks[place]; left; left &= left - 1) {
    const float* row = block_rows<1 + kChannels>(scratch, __builtin_ctzll(left))[0];
    const Wide w = load_wide(weight_row);
    largest = max_of(largest, w);
    sums[kChannels] = sums[kChannels] + w;
    for (int k = 0; k < kChannels; ++k)
      sums[k] = sums[k] + w * load_wide(row + (1 + k) * kBlockPixels);
    weight_row += kBlockPixels;
  }
  float* slot = slot_of(tile, group.splats[place], slots, channels + 2);
  for (int k = 0; k < channels; ++k) slot[k] = sum_of(sums[k]);
  slot[channels] = sum_of(sums[kChannels]);
  slot[channels + 1] = max_lane(largest);
}

template <int kChannels>
static void average_channels(const Tile& tile, const float* image, int channels,
                             TileScratch& scratch, float* slots) {
  const BlockGrid grid(tile);
  constexpr int kRows = 1 + kChannels;
  start_rows<kRows>(tile, scratch);
  for (int block = 0; block < kBlocksPerTile; ++block) {
    float(*values)[kBlockPixels] = block_rows<kRows>(scratch, block) + 1;
    BlockPixels(tile, block).for_each(tile, [&](int lane, int64_t pixel) {
      for (int k = 0; k < channels; ++k) values[k][lane] = image[pixel * channels + k];
    });
  }
  KeptGroups<kRows> groups;
  groups.template blend<false>(tile, grid, scratch, [&](const Splat& s) {
    clear_slot(tile, s, slots, channels + 2);
  });
  groups.visit_back_to_front(tile, grid, scratch, [&](const Group& group, const Kept& kept) {
    for (int i = 0; i < group.count; ++i)
      sum_channels<kChannels>(tile, group, i, kept, channels, scratch, slots);
  });
}

static void average_tile(const Tile& tile, const float* image, int channels, TileScratch& scratch,
                         float* slots) {
  if (channels == 0)
    average_channels<0>(tile, image, channels, scratch, slots);
  else if (channels == 1)
    average_channels<1>(tile, image, channels, scratch, slots);
  else if (channels <= 4)
    average_channels<4>(tile, image, channels, scratch, slots);
  else
    average_channels<kMaxChannels>(tile, image, channels, scratch, slots);
}

}  // namespace rgbavatar::RGBAVATAR_ISA
