// Forward pass, loss and backward pass of one tile in one go: no image is written.
#pragma once

#include "backward_tile.h"

namespace rgbavatar::RGBAVATAR_ISA {

// A block's RGBA pixels, one a lane; 0 outside the image.
static RGBAVATAR_MEMBER WideInt load_rgba(const Tile& tile, const BlockPixels& pixels,
                                          const uint8_t* rgba) {
  int32_t lanes[kBlockPixels] = {};
  if (pixels.whole())
    for (int y = 0; y < kBlockSide; ++y)
      __builtin_memcpy(lanes + y * kBlockSide, rgba + (pixels.first + int64_t(y) * tile.width) * 4,
                       4 * kBlockSide);
  else
    pixels.for_each(tile, [&](int lane, int64_t pixel) {
      __builtin_memcpy(lanes + lane, rgba + pixel * 4, 4);
    });
  return load_ints(lanes);
}

// 1 in the image, 0 outside.
static Wide lanes_inside(const Tile& tile, const BlockPixels& pixels) {
  float within[kBlockPixels] = {};
  pixels.for_each(tile, [&](int lane, int64_t) { within[lane] = 1.0f; });
  return load_wide(within);
}

// From the drawn rows to those of the backward pass: the channels become dL/dimage of the mean
// absolute difference, and what is behind g . background; both are 0 where nobody filmed. Returns
// the differences' sums.
static Wide compare_block(const Tile& tile, const TrainingTarget& target, int block,
                          TileScratch& scratch) {
  float(*rows)[kBlockPixels] = block_rows<kBlendRows>(scratch, block);
  const BlockPixels pixels(tile, block);
  const WideInt rgba = load_rgba(tile, pixels, target.rgba);
  const Wide zero(0.0f), one(1.0f), t = load_wide(rows[kTransmittance]);
  const Wide inside = pixels.whole() ? one : lanes_inside(tile, pixels);
  const Wide unlike = to_floats(rgba - WideInt(C::kUnfilmed));  // 0 for the mark alone
  const Wide counts = select(unlike * unlike > zero, inside, zero);
  const Wide matte = to_floats((rgba >> 24) & 255) * (1.0f / 255.0f);
  Wide behind = zero, sum = zero;
  for (int k = 0; k < 3; ++k) {
    const Wide background(target.background[k]);
    const Wide color = to_floats((rgba >> (8 * k)) & 255) * (1.0f / 255.0f);
    const Wide image = load_wide(rows[kColor + k]) + t * background;
    const Wide difference = (image - (background + matte * (color - background))) * counts;
    const Wide sign = select(difference > zero, one, zero) - select(zero > difference, one, zero);
    const Wide g = sign * target.gradient;
    sum = sum + sign * difference;
    behind = behind + g * background;
    store(g, rows[kColor + k]);
  }
  store(behind, rows[kBehind]);
  return sum;
}

static double train_tile(const Tile& tile, const TrainingTarget& target, TileScratch& scratch,
                         float* slots) {
  const BlockGrid grid(tile);
  KeptGroups<kBlendRows> groups;
  start_rows<kBlendRows>(tile, scratch);
  groups.template blend<true>(tile, grid, scratch,
                              [&](const Splat& s) { clear_slot(tile, s, slots, kMoments); });
  Wide sum(0.0f);
  for (int block = 0; block < kBlocksPerTile; ++block)
    sum = sum + compare_block(tile, target, block, scratch);
  groups.visit_back_to_front(tile, grid, scratch, [&](const Group& group, const Kept& kept) {
    sum_group(tile, grid, group, kept, scratch, slots);
  });
  return double(sum_of(sum));
}

}  // namespace rgbavatar::RGBAVATAR_ISA
