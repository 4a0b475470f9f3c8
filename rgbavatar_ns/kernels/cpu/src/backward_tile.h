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

// A block is that many registers, each of some of its rows.
constexpr int kParts = kLanes / kNativeLanes, kPartRows = kBlockSide / kParts;

// Where a part of a block lies from the first part of another one of its tile, in pixels, and what
// sums of squares need of that.
struct alignas(32) PartOffset {
  float x = 0.0f, y = 0.0f, xx = 0.0f, xy = 0.0f, yy = 0.0f;
};
struct alignas(64) PartOffsets {
  static constexpr int kStride = 2 * kTileBlocks, kLeft = kTileBlocks - 1;
  PartOffset of[kTileBlocks * kParts * kStride];

  constexpr PartOffsets() : of() {
    for (int down = 0; down < kTileBlocks * kParts; ++down)
      for (int across = -kLeft; across < kTileBlocks; ++across) {
        const float x = float(across * kBlockSide), y = float(down * kPartRows);
        of[down * kStride + across + kLeft] = {x, y, x * x, x * y, y * y};
      }
  }
  // Numbers of blocks whose differences say where one lies from another.
  static RGBAVATAR_MEMBER int place_of(int block) {
    return block + (block & -kTileBlocks) * (kParts * kStride / kTileBlocks - 1);
  }
  // Of the parts of a block from one that no other lies above.
  RGBAVATAR_MEMBER const PartOffset* between(int first_place, int place) const {
    return of + (place - first_place + kLeft);
  }
};
static constexpr PartOffsets kPartOffsets = {};

static RGBAVATAR_MEMBER Native load_native(const float* from) {
  Native a;
  load(a, from);
  return a;
}

// The sums over the jobs of one Gaussian of the group, which are written to its slot: of w
// dL/dcolour, of alpha dL/dalpha, and of this times dx, dy and their products. Afterwards the Gaussian
// stands behind those in front of it. Returns the largest weight, if that is asked for.
// All parts of a block are added to the same lanes. These lie where they do in the first block's first
// part, and the others' offsets are numbers: of the sums with them follow those with the distances.
template <bool kLargest>
static RGBAVATAR_MEMBER float sum_moments(const Tile& tile, const BlockGrid& grid,
                                          const Group& group, int place, const Kept& kept,
                                          TileScratch& scratch, float* slots) {
  const Splat& s = group.splats[place];
  const Native color_red(s.red), color_green(s.green), color_blue(s.blue), zero(0.0f);
  Native red = zero, green = zero, blue = zero, one = zero, x_sum = zero, y_sum = zero, xx = zero,
         xy = zero, yy = zero, largest = zero;
  const float* alpha_row = kept.alpha[group.first_job[place]];
  const float* weight_row = kept.weight[group.first_job[place]];
  const int first_block = __builtin_ctzll(group.blocks[place]);
  const int first_place = PartOffsets::place_of(first_block);
  for (uint64_t left = group.blocks[place]; left; left &= left - 1) {
    const int block = __builtin_ctzll(left);
    const PartOffset* offset = kPartOffsets.between(first_place, PartOffsets::place_of(block));
    float* row = block_rows<kBlendRows>(scratch, block)[0];
    for (int part = 0; part < kParts; ++part) {
      const Native g_red = load_native(row + kColor * kBlockPixels);
      const Native g_green = load_native(row + (kColor + 1) * kBlockPixels);
      const Native g_blue = load_native(row + (kColor + 2) * kBlockPixels);
      const Native behind = load_native(row + kBehind * kBlockPixels);
      const Native alpha = load_native(alpha_row), w = load_native(weight_row);
      if (kLargest) largest = max_of(largest, w);
      const Native more =
          g_red * color_red + g_green * color_green + g_blue * color_blue - behind;
      store(behind + alpha * more, row + kBehind * kBlockPixels);
      // alpha dL/dalpha, whose ln 2 follows below; the cap has no gradient.
      const Native d_p = select(Native(C::kMaxAlpha) > alpha, w * more, zero);
      red = red + w * g_red;
      green = green + w * g_green;
      blue = blue + w * g_blue;
      one = one + d_p;
      x_sum = x_sum + d_p * offset->x;
      y_sum = y_sum + d_p * offset->y;
      xx = xx + d_p * offset->xx;
      xy = xy + d_p * offset->xy;
      yy = yy + d_p * offset->yy;
      offset += PartOffsets::kStride;
      row += kNativeLanes;
      alpha_row += kNativeLanes;
      weight_row += kNativeLanes;
    }
  }
  const Native x = load_native(grid.x[first_block % kTileBlocks]) - s.mean_x;
  const Native y = load_native(grid.y[first_block / kTileBlocks]) - s.mean_y;
  const Native d_x = x * one + x_sum, d_y = y * one + y_sum;
  float* slot = slot_of(tile, s, slots, kMoments);
  const Quad units = {1.0f, 1.0f, 1.0f, C::kLn2};
  store_quad(sums_of(red, green, blue, one) * units, slot);
  store_quad(sums_of(d_x, d_y, x * (d_x + x_sum) + xx, x * d_y + (y * x_sum + xy)) * C::kLn2,
             slot + 4);
  slot[8] = sum_of(y * (d_y + y_sum) + yy) * C::kLn2;
  return kLargest ? max_lane(largest) : 0.0f;
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
