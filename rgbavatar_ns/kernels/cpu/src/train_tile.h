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

// A block's target: colour and matte of its pixels, and 1 where someone filmed in the image.
struct TargetBlock {
  Wide color[3], matte, filmed;

  TargetBlock(const Tile& tile, const TrainingTarget& target, int block) {
    const BlockPixels pixels(tile, block);
    const WideInt rgba = load_rgba(tile, pixels, target.rgba);
    const Wide zero(0.0f), one(1.0f), inside = pixels.whole() ? one : lanes_inside(tile, pixels);
    const Wide unlike = to_floats(rgba - WideInt(C::kUnfilmed));  // 0 for the mark alone
    filmed = select(unlike * unlike > zero, inside, zero);
    matte = to_floats((rgba >> 24) & 255) * (1.0f / 255.0f);
    for (int k = 0; k < 3; ++k) color[k] = to_floats((rgba >> (8 * k)) & 255) * (1.0f / 255.0f);
  }
  Wide over(const float* background, int k) const {
    return background[k] + matte * (color[k] - background[k]);
  }
};

// From the drawn rows to those of the backward pass: the channels become dL/dimage of the mean
// absolute difference, and what is behind g . background; both are 0 where nobody filmed. Returns
// the differences' sums.
static Wide compare_block(const Tile& tile, const TrainingTarget& target, int block,
                          TileScratch& scratch) {
  float(*rows)[kBlockPixels] = block_rows<kBlendRows>(scratch, block);
  const TargetBlock filmed(tile, target, block);
  const Wide zero(0.0f), one(1.0f), t = load_wide(rows[kTransmittance]);
  Wide behind = zero, sum = zero;
  for (int k = 0; k < 3; ++k) {
    const Wide background(target.background[k]);
    const Wide image = load_wide(rows[kColor + k]) + t * background;
    const Wide difference = (image - filmed.over(target.background, k)) * filmed.filmed;
    const Wide sign = select(difference > zero, one, zero) - select(zero > difference, one, zero);
    const Wide g = sign * target.gradient;
    sum = sum + sign * difference;
    behind = behind + g * background;
    store(g, rows[kColor + k]);
  }
  store(behind, rows[kBehind]);
  return sum;
}

// What the pixels of a block count for a first colour: colour times share, and the share.
static void count_block(const Tile& tile, const TrainingTarget& target, int block,
                        TileScratch& scratch) {
  float(*counted)[kBlockPixels] = scratch.counted + 4 * block;
  const TargetBlock filmed(tile, target, block);
  const bool whole = target.sight->over_background;
  const Wide share = whole ? filmed.filmed : filmed.matte * filmed.filmed;
  for (int k = 0; k < 3; ++k)
    store(share * (whole ? filmed.over(target.background, k) : filmed.color[k]), counted[k]);
  store(share, counted[3]);
}

static RGBAVATAR_MEMBER bool waits(const FirstSight& sight, const Splat& s) {
  return !sight.known[s.index] && s.log2_opacity > sight.log2_threshold;
}

// Sums what a group's Gaussian counts in the tile; `counted` are the blocks whose pixels have been.
static void sum_counted(const Tile& tile, const TrainingTarget& target, const Group& group,
                        int place, const Kept& kept, TileScratch& scratch, uint64_t& counted,
                        float sums[4]) {
  const uint64_t blocks = group.blocks[place];
  for (uint64_t left = blocks & ~counted; left; left &= left - 1)
    count_block(tile, target, __builtin_ctzll(left), scratch);
  counted |= blocks;
  const Wide zero(0.0f);
  Wide lanes[4] = {zero, zero, zero, zero};
  const float* weight_row = kept.weight[group.first_job[place]];
  for (uint64_t left = blocks; left; left &= left - 1, weight_row += kBlockPixels) {
    const float(*rows)[kBlockPixels] = scratch.counted + 4 * __builtin_ctzll(left);
    const Wide weight = load_wide(weight_row);
    for (int k = 0; k < 4; ++k) lanes[k] = lanes[k] + weight * load_wide(rows[k]);
  }
  store_quad(sums_of(lanes[0], lanes[1], lanes[2], lanes[3]), sums);
}

// Hands a tile's sightings over, to where those of all tiles are.
static void hand_over(const TileScratch& scratch, int count, Sightings& to) {
  const int64_t first = __atomic_fetch_add(&to.count, count, __ATOMIC_RELAXED);
  __builtin_memcpy(to.seen + first, scratch.sightings, count * sizeof(Sighting));
}

static double train_tile(const Tile& tile, const TrainingTarget& target, TileScratch& scratch,
                         float* slots) {
  const BlockGrid grid(tile);
  KeptGroups<kBlendRows> groups;
  start_rows<kBlendRows>(tile, scratch);
  groups.template blend<true>(tile, grid, scratch,
                              [&](const Splat& s) { clear_slot(tile, s, slots, kMoments); });
  Wide sum(0.0f);
  uint64_t counted = 0;
  int sightings = 0;
  for (int block = 0; block < kBlocksPerTile; ++block)
    sum = sum + compare_block(tile, target, block, scratch);
  groups.visit_back_to_front(tile, grid, scratch, [&](const Group& group, const Kept& kept) {
    for (int i = group.count; i-- > 0;) {
      if (!target.sight || !waits(*target.sight, group.splats[i])) {
        sum_moments<false>(tile, grid, group, i, kept, scratch, slots);
        continue;
      }
      const float most = sum_moments<true>(tile, grid, group, i, kept, scratch, slots);
      if (!(most > 0.0f)) continue;  // hidden by what lies before it
      if (sightings == kKeptSightings) {
        hand_over(scratch, sightings, *target.sightings);
        sightings = 0;
      }
      Sighting& seen = scratch.sightings[sightings++];
      seen.blocks = group.blocks[i];
      seen.index = group.splats[i].index;
      seen.most = most;
      seen.tile = target.tile;
      seen.summed = most >= target.sight->threshold;
      if (seen.summed) sum_counted(tile, target, group, i, kept, scratch, counted, seen.sums);
    }
  });
  if (sightings) hand_over(scratch, sightings, *target.sightings);
  return double(sum_of(sum));
}

// Blends again, in the blocks of these sightings, what lies before them and themselves.
static void see_tile(const Tile& tile, const TrainingTarget& target, TileScratch& scratch,
                     Sighting* sightings, int count) {
  const BlockGrid grid(tile);
  GroupReader reader(tile);
  Group& group = scratch.groups[0];
  const Kept kept = kept_from(scratch, 0);
  start_rows<kBlendRows>(tile, scratch);
  uint64_t open = 0, counted = 0;
  for (int i = 0; i < count; ++i) open |= sightings[i].blocks;
  for (int left = count; left && reader.next(group, open, kNoLimit, [](const Splat&) {});) {
    open &= ~blend_group<kBlendRows, false, false, true>(grid, group, scratch, kept);
    for (int i = 0; i < group.count; ++i) {
      if (!waits(*target.sight, group.splats[i])) continue;
      for (int k = 0; k < count; ++k) {
        if (sightings[k].index != uint32_t(group.splats[i].index)) continue;
        sum_counted(tile, target, group, i, kept, scratch, counted, sightings[k].sums);
        sightings[k].summed = true;
        --left;
      }
    }
  }
}

}  // namespace rgbavatar::RGBAVATAR_ISA
