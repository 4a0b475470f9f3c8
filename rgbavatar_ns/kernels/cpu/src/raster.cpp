#include "raster.h"

#include <algorithm>
#include <cstring>
#include <mutex>
#include <stdexcept>

#include "team.h"

namespace rgbavatar {

namespace {

constexpr size_t kKeptWorkspaces = 2;
std::mutex pool_mutex;

std::vector<std::unique_ptr<Workspace>>& pool() {
  static auto* kept = new std::vector<std::unique_ptr<Workspace>>;  // outlives every Rendering
  return *kept;
}

std::unique_ptr<Workspace> take_workspace() {
  std::lock_guard<std::mutex> lock(pool_mutex);
  if (pool().empty()) return std::make_unique<Workspace>();
  std::unique_ptr<Workspace> workspace = std::move(pool().back());
  pool().pop_back();
  return workspace;
}

void give_workspace(std::unique_ptr<Workspace> workspace) {
  std::lock_guard<std::mutex> lock(pool_mutex);
  if (pool().size() < kKeptWorkspaces) pool().push_back(std::move(workspace));
}

// Gaussians that one thread projects at a time; a multiple of the SIMD lanes.
constexpr int kChunk = 2048;
int chunks_of(int count) { return (count + kChunk - 1) / kChunk; }

// Sorts keys by their upper half, keeping the order of equal ones. Only the bits that differ from
// the smallest key are sorted: within a tile that a head's Gaussians touch, two or three passes.
// Returns where the result is: `keys` or `other`.
const uint64_t* radix_sort(uint64_t* keys, uint64_t* other, size_t count) {
  constexpr int kBits = 8, kBuckets = 1 << kBits;
  uint64_t smallest = ~uint64_t(0), largest = 0;
  for (size_t i = 0; i < count; ++i) {
    smallest = std::min(smallest, keys[i] >> 32);
    largest = std::max(largest, keys[i] >> 32);
  }
  for (int shift = 0; count > 0 && (largest - smallest) >> shift; shift += kBits) {
    uint32_t start[kBuckets] = {};
    const auto bucket = [&](uint64_t key) {
      return (((key >> 32) - smallest) >> shift) & (kBuckets - 1);
    };
    for (size_t i = 0; i < count; ++i) ++start[bucket(keys[i])];
    uint32_t total = 0;
    for (uint32_t& s : start) {
      const uint32_t here = s;
      s = total;
      total += here;
    }
    for (size_t i = 0; i < count; ++i) other[start[bucket(keys[i])]++] = keys[i];
    std::swap(keys, other);
  }
  return keys;
}

// Tiles first..last that a Gaussian touches.
struct TileSpan {
  uint32_t first_x, first_y, last_x, last_y;

  // Of blocks x | y << 16.
  TileSpan(uint32_t first_block, uint32_t last_block)
      : first_x((first_block & 0xffff) >> kTileBlocksShift),
        first_y(first_block >> (16 + kTileBlocksShift)),
        last_x((last_block & 0xffff) >> kTileBlocksShift),
        last_y(last_block >> (16 + kTileBlocksShift)) {}

  // Calls visit(tile) row by row, and for Gaussians of up to 2 x 2 tiles, which are nearly all, four
  // times always, with `none` for what is missing: a processor does not guess which ones are.
  template <class Visit>
  void for_each(uint32_t tiles_x, uint32_t none, const Visit& visit) const {
    const uint32_t first = first_y * tiles_x + first_x;
    const bool right = last_x > first_x, below = last_y > first_y;
    if (last_x - first_x < 2 && last_y - first_y < 2) {
      visit(first);
      visit(right ? first + 1 : none);
      visit(below ? first + tiles_x : none);
      visit(right & below ? first + tiles_x + 1 : none);
      return;
    }
    for (uint32_t y = first_y; y <= last_y; ++y)
      for (uint32_t x = first_x; x <= last_x; ++x) visit(y * tiles_x + x);
  }
};

bool is_visible(uint32_t first_block, uint32_t last_block) {
  return (first_block & 0xffff) <= (last_block & 0xffff);
}

}  // namespace

Rendering::Rendering(int batch, int count, int width, int height, const Cameras& cameras,
                     const std::string& instruction_set)
    : batch_(batch),
      count_(count),
      width_(width),
      height_(height),
      tiles_x_((width + kTileBlocks * kBlockSide - 1) / (kTileBlocks * kBlockSide)),
      tiles_y_((height + kTileBlocks * kBlockSide - 1) / (kTileBlocks * kBlockSide)),
      kernels_(kernels_for(instruction_set)),
      workspace_(take_workspace()) {
  Workspace& w = *workspace_;
  w.cameras.reserve(size_t(batch_) * kCameraFloats);
  w.splats.reserve(size_t(batch_) * count_);
  w.depth.reserve(size_t(batch_) * count_);
  w.bounds.reserve(size_t(2) * batch_ * count_);
  w.projected.reserve(batch_);
  for (int image = 0; image < batch_; ++image) {
    const int from = cameras.count == 1 ? 0 : image;
    float* to = &w.cameras[size_t(image) * kCameraFloats];
    std::memcpy(to, cameras.world_to_camera + from * 16, 16 * sizeof(float));
    std::memcpy(to + 16, cameras.focal_px + from * 2, 2 * sizeof(float));
    std::memcpy(to + 18, cameras.principal_point_px + from * 2, 2 * sizeof(float));
    const size_t first = size_t(image) * count_;
    w.projected[image] = {w.splats.data() + first, w.depth.data() + first,
                          w.bounds.data() + first,
                          w.bounds.data() + size_t(batch_) * count_ + first};
  }
}

Rendering::Rendering(const Scene& scene, const Cameras& cameras,
                     const std::string& instruction_set, int threads)
    : Rendering(scene.batch, scene.count, scene.width, scene.height, cameras, instruction_set) {
  Team team(threads);
  Workspace& w = *workspace_;
  const int chunks = chunks_of(count_);
  team.run(int64_t(batch_) * chunks, [&](int64_t item, int) {
    const int image = int(item / chunks), begin = int(item % chunks) * kChunk;
    kernels_->project(scene, &w.cameras[size_t(image) * kCameraFloats], image, begin,
                      std::min(begin + kChunk, count_), w.projected[image]);
  });
  sort(team);
}

Rendering::~Rendering() { give_workspace(std::move(workspace_)); }

// First into tiles, in the order of memory, which is often that of the surface; then front to back
// within each tile, whose entries lie in the nearest cache.
void Rendering::sort(Team& team) {
  Workspace& w = *workspace_;
  const int tiles = tiles_per_image();
  w.slot_offset.reserve(size_t(batch_) * (count_ + 1));
  w.tile_start.reserve(size_t(batch_) * (tiles + 1));
  w.slot_start.reserve(batch_ + 1);
  w.slot_count.reserve(batch_);
  if (int(w.images.size()) < batch_) w.images.resize(batch_);
  team.run(batch_, [&](int64_t image, int) { bin_image(int(image)); });
  w.slot_start[0] = 0;
  uint32_t most = 0;
  for (int image = 0; image < batch_; ++image) {
    if (w.slot_count[image] > UINT32_MAX)
      throw std::invalid_argument(
          "The Gaussians of one image touch more than 2^32 tiles. Render a smaller image or check "
          "the Gaussians' scales.");
    w.slot_start[image + 1] = w.slot_start[image] + w.slot_count[image];
    const uint32_t* start = &w.tile_start[size_t(image) * (tiles + 1)];
    for (int tile = 0; tile < tiles; ++tile) most = std::max(most, start[tile + 1] - start[tile]);
  }
  w.sort_keys.reserve(size_t(team.size()) * 2 * most);
  team.run(int64_t(batch_) * tiles, [&](int64_t item, int thread) {
    sort_tile(int(item / tiles), int(item % tiles), &w.sort_keys[size_t(thread) * 2 * most], most);
  });
}

void Rendering::bin_image(int image) {
  Workspace& w = *workspace_;
  const Projected& from = w.projected[image];
  const uint32_t tiles_x = uint32_t(tiles_x_), none = uint32_t(tiles_per_image());
  uint32_t* start = w.tile_start.data() + size_t(image) * (none + 1);
  uint32_t* slot_offset = w.slot_offset.data() + size_t(image) * (count_ + 1);
  std::fill(start, start + none + 1, 0u);
  size_t slots = 0;
  for (int i = 0; i < count_; ++i) {
    slot_offset[i] = uint32_t(slots);
    if (!is_visible(from.first_block[i], from.last_block[i])) continue;
    const TileSpan span(from.first_block[i], from.last_block[i]);
    span.for_each(tiles_x, none, [&](uint32_t tile) { ++start[tile]; });
    slots += size_t(span.last_x - span.first_x + 1) * (span.last_y - span.first_y + 1);
  }
  slot_offset[count_] = uint32_t(slots);
  w.slot_count[image] = slots;
  if (slots > UINT32_MAX) return;
  uint32_t total = 0;
  start[none] = 0;
  for (uint32_t tile = 0; tile <= none; ++tile) {
    const uint32_t here = start[tile];
    start[tile] = total;
    total += here;
  }
  ImageEntries& entries = w.images[image];
  entries.sorted.reserve(slots);
  entries.binned.reserve(slots + 1);  // `none` writes behind the last one
  entries.depth_bits.reserve(slots + 1);
  uint32_t slot = 0;
  for (int i = 0; i < count_; ++i) {
    if (!is_visible(from.first_block[i], from.last_block[i])) continue;
    uint32_t depth_bits;  // of a positive float: ordered like the float
    std::memcpy(&depth_bits, &from.depth[i], sizeof depth_bits);
    const TileSpan span(from.first_block[i], from.last_block[i]);
    span.for_each(tiles_x, none, [&](uint32_t tile) {
      const uint32_t place = start[tile];
      entries.binned[place] = {uint32_t(i), slot};
      entries.depth_bits[place] = depth_bits;
      start[tile] += tile != none;
      slot += tile != none;
    });
  }
  // Each start has moved to the next tile's; move them back.
  for (uint32_t tile = none; tile > 0; --tile) start[tile] = start[tile - 1];
  start[0] = 0;
}

void Rendering::sort_tile(int image, int index, uint64_t* keys, uint32_t most) {
  Workspace& w = *workspace_;
  ImageEntries& entries = w.images[image];
  const uint32_t* start = w.tile_start.data() + size_t(image) * (tiles_per_image() + 1) + index;
  const uint32_t first = start[0], count = start[1] - start[0];
  for (uint32_t i = 0; i < count; ++i)
    keys[i] = uint64_t(entries.depth_bits[first + i]) << 32 | i;
  const uint64_t* sorted = radix_sort(keys, keys + most, count);
  for (uint32_t i = 0; i < count; ++i)
    entries.sorted[first + i] = entries.binned[first + uint32_t(sorted[i])];
}

Tile Rendering::tile(int image, int index) const {
  const Workspace& w = *workspace_;
  const uint32_t* start = w.tile_start.data() + size_t(image) * (tiles_per_image() + 1) + index;
  return {w.projected[image].splats,
          w.images[image].sorted.data() + start[0],
          start[1] - start[0],
          index % tiles_x_,
          index / tiles_x_,
          width_,
          height_};
}

// `width` floats a slot.
void Rendering::lay_out_slots(int width) {
  Workspace& w = *workspace_;
  w.slots.reserve(w.slot_start[batch_] * width + 3);
  w.image_slots.reserve(batch_);
  for (int image = 0; image < batch_; ++image)
    w.image_slots[image] = {w.slot_offset.data() + size_t(image) * (count_ + 1),
                            w.slots.data() + w.slot_start[image] * width};
}

void Rendering::draw(const Attribute& background, float* image, float* alpha, float* depth,
                     int threads) {
  Team team(threads);
  workspace_->scratch.reserve(team.size());
  const size_t pixels = size_t(width_) * height_;
  team.run(int64_t(batch_) * tiles_per_image(), [&](int64_t item, int thread) {
    const int b = int(item / tiles_per_image());
    const ForwardOutput out = {background.of(b), image + b * pixels * 3, alpha + b * pixels,
                               depth ? depth + b * pixels : nullptr};
    kernels_->forward_tile(tile(b, int(item % tiles_per_image())), out,
                           workspace_->scratch[thread]);
  });
}

void Rendering::average(const Attribute& images, int channels, float* weighted_sum,
                        float* weight_sum, float* max_weight, int threads) {
  Team team(threads);
  Workspace& w = *workspace_;
  const int width = channels + 2;
  w.scratch.reserve(team.size());
  lay_out_slots(width);
  team.run(int64_t(batch_) * tiles_per_image(), [&](int64_t item, int thread) {
    const int b = int(item / tiles_per_image());
    kernels_->average_tile(tile(b, int(item % tiles_per_image())), images.of(b), channels,
                           w.scratch[thread], w.slots.data() + w.slot_start[b] * width);
  });
  const int chunks = chunks_of(count_);
  team.run(int64_t(batch_) * chunks, [&](int64_t item, int) {
    const int b = int(item / chunks), begin = int(item % chunks) * kChunk;
    const ImageSlots& image = w.image_slots[b];
    for (int i = begin; i < std::min(begin + kChunk, count_); ++i) {
      float sums[kMaxChannels + 2] = {};
      for (uint32_t k = image.offset[i]; k < image.offset[i + 1]; ++k) {
        const float* slot = image.slots + size_t(k) * width;
        for (int c = 0; c <= channels; ++c) sums[c] += slot[c];
        sums[channels + 1] = std::max(sums[channels + 1], slot[channels + 1]);
      }
      const size_t row = size_t(b) * count_ + i;
      if (weighted_sum) std::copy(sums, sums + channels, weighted_sum + row * channels);
      if (weight_sum) weight_sum[row] = sums[channels];
      if (max_weight) max_weight[row] = sums[channels + 1];
    }
  });
}

void Rendering::backward(const Scene& scene, const BackwardInput& input,
                         const SceneGradient& gradient, int threads) {
  Team team(threads);
  Workspace& w = *workspace_;
  w.scratch.reserve(team.size());
  lay_out_slots(kMoments);
  const size_t pixels = size_t(width_) * height_;
  team.run(int64_t(batch_) * tiles_per_image(), [&](int64_t item, int thread) {
    const int b = int(item / tiles_per_image());
    const auto of_image = [&](const float* data, int width) {
      return data ? data + b * pixels * width : nullptr;
    };
    const BackwardInput in = {of_image(input.image, 3), of_image(input.alpha, 1),
                              of_image(input.image_grad, 3), of_image(input.alpha_grad, 1)};
    kernels_->backward_tile(tile(b, int(item % tiles_per_image())), in, w.scratch[thread],
                            w.slots.data() + w.slot_start[b] * kMoments);
  });
  team.run(chunks_of(count_), [&](int64_t chunk, int) {
    // Every chunk takes the images in order, so that sums over them have one order.
    const int begin = int(chunk) * kChunk, end = std::min(begin + kChunk, count_);
    for (int b = 0; b < batch_; ++b)
      kernels_->project_backward(scene, &w.cameras[size_t(b) * kCameraFloats], b, begin, end,
                                 w.image_slots[b], gradient);
  });
}

}  // namespace rgbavatar
