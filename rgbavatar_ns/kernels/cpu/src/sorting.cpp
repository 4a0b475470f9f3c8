// Gaussians into tiles, and front to back within each.
#include <algorithm>
#include <cstring>
#include <stdexcept>

#include "raster.h"
#include "team.h"

namespace rgbavatar {

namespace {

// Sorts keys by their upper half, keeping the order of equal ones. Only the bits that differ from
// the smallest key are sorted: within a tile that a head's Gaussians touch, two or three passes.
void radix_sort(uint64_t* keys, uint64_t* spare, size_t count) {
  constexpr int kBits = 8, kBuckets = 1 << kBits;
  uint64_t smallest = ~uint64_t(0), largest = 0;
  for (size_t i = 0; i < count; ++i) {
    smallest = std::min(smallest, keys[i] >> 32);
    largest = std::max(largest, keys[i] >> 32);
  }
  uint64_t *from = keys, *to = spare;
  for (int shift = 0; count > 0 && (largest - smallest) >> shift; shift += kBits) {
    uint32_t start[kBuckets] = {};
    const auto bucket = [&](uint64_t key) {
      return (((key >> 32) - smallest) >> shift) & (kBuckets - 1);
    };
    for (size_t i = 0; i < count; ++i) ++start[bucket(from[i])];
    uint32_t total = 0;
    for (uint32_t& s : start) {
      const uint32_t here = s;
      s = total;
      total += here;
    }
    for (size_t i = 0; i < count; ++i) to[start[bucket(from[i])]++] = from[i];
    std::swap(from, to);
  }
  if (from != keys) std::copy(from, from + count, keys);
}

// Calls visit(tile) row by row for the tiles that a Gaussian touches, and for one of up to 2 x 2
// tiles, which nearly all are, four times always, with `none` for what is missing: a processor does
// not guess which ones are. Returns how many it touches.
template <class Visit>
size_t for_each_tile(const Projected& image, int i, const Visit& visit) {
  const uint32_t tiles = image.tiles[i], tiles_x = uint32_t(image.tiles_x);
  const uint32_t none = uint32_t(image.tile_count);
  if (__builtin_expect(tiles == kManyTiles, false)) {
    const Bounds& b = image.splats[i].bounds;
    const uint32_t first_x = b.first_block_x >> kTileBlocksShift;
    const uint32_t first_y = b.first_block_y >> kTileBlocksShift;
    const uint32_t last_x = b.last_block_x >> kTileBlocksShift;
    const uint32_t last_y = b.last_block_y >> kTileBlocksShift;
    for (uint32_t y = first_y; y <= last_y; ++y)
      for (uint32_t x = first_x; x <= last_x; ++x) visit(y * tiles_x + x);
    return size_t(last_x - first_x + 1) * (last_y - first_y + 1);
  }
  const uint32_t first = tiles >> kTileShift;
  const bool right = tiles & kTileRight, below = tiles & kTileBelow;
  visit(first);
  visit(right ? first + 1 : none);
  visit(below ? first + tiles_x : none);
  visit((right & below) ? first + tiles_x + 1 : none);
  return size_t(first != none) << (right + below);
}

}  // namespace

int Rendering::parts_per_image() const { return (count_ + kPart - 1) / kPart; }

uint32_t* Rendering::part_start(int image, int part) {
  const size_t row = size_t(image) * parts_per_image() + part;
  return workspace_->part_start.data() + row * (tiles_per_image() + 1);
}

// First into tiles, in the order of memory, which is often that of the surface; then front to back
// within each tile, whose entries lie in the nearest cache.
void Rendering::sort(Team& team) {
  make_room_for_entries();
  const int tiles = tiles_per_image(), parts = parts_per_image();
  team.run(int64_t(batch_) * parts,
           [&](int64_t item, int) { count_part(int(item / parts), int(item % parts)); });
  put_into_tiles(team, true);
  team.run(int64_t(batch_) * tiles, [&](int64_t item, int thread) {
    sort_tile(int(item / tiles), int(item % tiles), thread);
  });
}

void Rendering::make_room_for_entries() {
  Workspace& w = *workspace_;
  const int tiles = tiles_per_image(), parts = parts_per_image();
  w.slot_offset.reserve(size_t(batch_) * (count_ + 1));
  w.tile_start.reserve(size_t(batch_) * (tiles + 1));
  w.slot_start.reserve(batch_ + 1);
  w.part_start.reserve(size_t(batch_) * parts * (tiles + 1));
  w.part_slots.reserve(size_t(batch_) * parts);
  if (int(w.entries.size()) < batch_) w.entries.resize(batch_);
}

void Rendering::put_into_tiles(Team& team, bool with_slots) {
  Workspace& w = *workspace_;
  const int tiles = tiles_per_image(), parts = parts_per_image();
  w.slot_start[0] = 0;
  for (int image = 0; image < batch_; ++image) {
    const size_t* slots = w.part_slots.data() + size_t(image) * parts;
    size_t total = 0;
    for (int part = 0; part < parts; ++part) total += slots[part];
    if (total > UINT32_MAX)
      throw std::invalid_argument(
          "The Gaussians of one image touch more than 2^32 tiles. Render a smaller image or check "
          "the Gaussians' scales.");
    w.slot_start[image + 1] = w.slot_start[image] + total;
    w.entries[image].reserve(total + 1);  // `none` writes behind the last one
  }
  team.run(batch_, [&](int64_t image, int) { lay_out_entries(int(image)); });
  const auto fill = [&](int image, int part) {
    with_slots ? fill_part<true>(image, part) : fill_part<false>(image, part);
  };
  // A tile's entries lie side by side, so that two threads take longer over one image than one.
  if (2 * batch_ >= team.size())
    team.run(batch_, [&](int64_t image, int) {
      for (int part = 0; part < parts; ++part) fill(int(image), part);
    });
  else
    team.run(parts, [&](int64_t part, int) {
      for (int image = 0; image < batch_; ++image) fill(image, int(part));
    });
  w.most_entries = 0;
  for (int image = 0; image < batch_; ++image) {
    const uint32_t* start = &w.tile_start[size_t(image) * (tiles + 1)];
    for (int tile = 0; tile < tiles; ++tile)
      w.most_entries = std::max(w.most_entries, start[tile + 1] - start[tile]);
  }
  w.sort_keys.reserve(size_t(team.size()) * w.most_entries);
}

void Rendering::sort_tile(int image, int tile, int thread) {
  Workspace& w = *workspace_;
  const uint32_t* start = &w.tile_start[size_t(image) * (tiles_per_image() + 1) + tile];
  radix_sort(w.entries[image].data() + start[0],
             w.sort_keys.data() + size_t(thread) * w.most_entries, start[1] - start[0]);
}

void Rendering::count_part(int image, int part) {
  const Projected& from = workspace_->projected[image];
  uint32_t* counts = part_start(image, part);
  std::fill(counts, counts + tiles_per_image() + 1, 0u);
  size_t slots = 0;
  for (int i = part * kPart; i < std::min((part + 1) * kPart, count_); ++i)
    slots += for_each_tile(from, i, [&](uint32_t tile) { ++counts[tile]; });
  workspace_->part_slots[size_t(image) * parts_per_image() + part] = slots;
}

// Where each tile's entries begin, and within those each part's.
void Rendering::lay_out_entries(int image) {
  const int tiles = tiles_per_image(), parts = parts_per_image();
  uint32_t* tile_start = &workspace_->tile_start[size_t(image) * (tiles + 1)];
  uint32_t total = 0;
  for (int tile = 0; tile < tiles; ++tile) {
    tile_start[tile] = total;
    for (int part = 0; part < parts; ++part) {
      uint32_t& start = part_start(image, part)[tile];
      const uint32_t here = start;
      start = total;
      total += here;
    }
  }
  tile_start[tiles] = total;
  for (int part = 0; part < parts; ++part) part_start(image, part)[tiles] = total;
}

// Writes a part's entries, and where its Gaussians' slots begin where that is asked for.
template <bool kWithSlots>
void Rendering::fill_part(int image, int part) {
  Workspace& w = *workspace_;
  const Projected& from = w.projected[image];
  const uint32_t none = uint32_t(from.tile_count);
  uint64_t* entries = w.entries[image].data();
  uint32_t* start = part_start(image, part);
  uint32_t* slot_offset = w.slot_offset.data() + size_t(image) * (count_ + 1);
  const size_t* slots = w.part_slots.data() + size_t(image) * parts_per_image();
  size_t slot = 0;
  for (int i = 0; i < part; ++i) slot += slots[i];
  const int end = std::min((part + 1) * kPart, count_);
  for (int i = part * kPart; i < end; ++i) {
    if (kWithSlots) {
      slot_offset[i] = from.splats[i].first_slot = uint32_t(slot);
      from.splats[i].index = uint32_t(i);
    }
    uint32_t depth_bits;  // of a positive float: ordered like the float
    std::memcpy(&depth_bits, &from.depth[i], sizeof depth_bits);
    const uint64_t entry = uint64_t(depth_bits) << 32 | uint32_t(i);
    slot += for_each_tile(from, i, [&](uint32_t tile) {
      entries[start[tile]] = entry;
      start[tile] += tile != none;
    });
  }
  if (kWithSlots && end == count_) slot_offset[count_] = uint32_t(slot);
}

}  // namespace rgbavatar
