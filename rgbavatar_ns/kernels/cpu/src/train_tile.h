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

static int64_t in_sight_units(float sum) { return int64_t(double(sum) * kSightUnit); }

// Adds a Gaussian's sums over a tile to those of its first sight.
static void add_to_sight(float sums[kSightSums], int64_t* to) {
  for (int k = 0; k + 1 < kSightSums; ++k)
    __atomic_fetch_add(to + k, in_sight_units(sums[k]), __ATOMIC_RELAXED);
  const int64_t largest = in_sight_units(sums[kSightSums - 1]);
  int64_t known = __atomic_load_n(to + kSightSums - 1, __ATOMIC_RELAXED);
  while (known < largest && !__atomic_compare_exchange_n(to + kSightSums - 1, &known, largest, true,
                                                         __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {
  }
}

// What a group's waiting Gaussians are seen with.
static void see_group(const Tile& tile, const TrainingTarget& target, const Group& group,
                      const Kept& kept) {
  const Wide zero(0.0f);
  for (int place = 0; place < group.count; ++place) {
    const Splat& s = group.splats[place];
    if (!s.waiting) continue;
    const float* weight_row = kept.weight[group.first_job[place]];
    Wide largest(0.0f);
    const float* row = weight_row;
    for (uint64_t left = group.blocks[place]; left; left &= left - 1, row += kBlockPixels)
      largest = max_of(largest, load_wide(row));
    const float most = max_lane(largest);
    if (!(most > 0.0f)) continue;  // hidden by what lies before it
    Wide sums[3] = {zero, zero, zero}, weight(0.0f);
    for (uint64_t left = group.blocks[place]; left; left &= left - 1, weight_row += kBlockPixels) {
      const Wide whole = load_wide(weight_row);
      const BlockPixels pixels(tile, __builtin_ctzll(left));
      const WideInt rgba = load_rgba(tile, pixels, target.rgba);
      const Wide unlike = to_floats(rgba - WideInt(C::kUnfilmed));  // 0 for the mark alone
      const Wide matte = to_floats((rgba >> 24) & 255) * (1.0f / 255.0f);
      const Wide w = select(unlike * unlike > zero, whole, zero);
      const Wide counted = target.sight->over_background ? w : w * matte;
      for (int k = 0; k < 3; ++k) {
        Wide color = to_floats((rgba >> (8 * k)) & 255) * (1.0f / 255.0f);
        if (target.sight->over_background)
          color = target.background[k] + matte * (color - target.background[k]);
        sums[k] = sums[k] + counted * color;
      }
      weight = weight + counted;
    }
    float all[kSightSums] = {sum_of(sums[0]), sum_of(sums[1]), sum_of(sums[2]), sum_of(weight), most};
    add_to_sight(all, target.sight->sums + int64_t(s.waiting - 1) * kSightSums);
  }
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
    if (target.sight) see_group(tile, target, group, kept);
  });
  return double(sum_of(sum));
}

}  // namespace rgbavatar::RGBAVATAR_ISA
