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

// Sorts keys by their upper half, keeping the order of equal ones; the low half is the Gaussian.
// Only the bits that differ from the smallest key are sorted: for a head in front of a camera two
// passes of 11 bits. Returns where the result is: `keys` or `other`.
uint64_t* radix_sort(uint64_t* keys, uint64_t* other, size_t count) {
  if (count == 0) return keys;
  constexpr int kBits = 11, kBuckets = 1 << kBits;
  uint64_t smallest = ~uint64_t(0), largest = 0;
  for (size_t i = 0; i < count; ++i) {
    smallest = std::min(smallest, keys[i] >> 32);
    largest = std::max(largest, keys[i] >> 32);
  }
  for (int shift = 0; (largest - smallest) >> shift; shift += kBits) {
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

template <class Visit>
void for_tiles(const Bounds& s, int tiles_x, Visit visit) {
  const int first_x = s.first_tile_x(), last_x = s.last_block_x >> kTileBlocksShift;
  const int last_y = s.last_block_y >> kTileBlocksShift;
  for (int y = s.first_tile_y(); y <= last_y; ++y)
    for (int x = first_x; x <= last_x; ++x) visit(y * tiles_x + x);
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
  w.bounds.reserve(size_t(batch_) * count_);
  w.projected.reserve(batch_);
  for (int image = 0; image < batch_; ++image) {
    const int from = cameras.count == 1 ? 0 : image;
    float* to = &w.cameras[size_t(image) * kCameraFloats];
    std::memcpy(to, cameras.world_to_camera + from * 16, 16 * sizeof(float));
    std::memcpy(to + 16, cameras.focal_px + from * 2, 2 * sizeof(float));
    std::memcpy(to + 18, cameras.principal_point_px + from * 2, 2 * sizeof(float));
    const size_t first = size_t(image) * count_;
    w.projected[image] = {w.splats.data() + first, w.depth.data() + first,
                          w.bounds.data() + first};
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

void Rendering::sort(Team& team) {
  Workspace& w = *workspace_;
  w.slot_offset.reserve(size_t(batch_) * (count_ + 1));
  w.tile_start.reserve(size_t(batch_) * (tiles_per_image() + 1));
  w.slot_start.reserve(batch_ + 1);
  w.slot_count.reserve(batch_);
  w.sort_keys.reserve(size_t(team.size()) * 2 * count_);
  if (int(w.entries.size()) < batch_) w.entries.resize(batch_);
  team.run(batch_, [&](int64_t image, int thread) {
    sort_image(int(image), w.sort_keys.data() + size_t(thread) * 2 * count_);
  });
  w.slot_start[0] = 0;
  for (int image = 0; image < batch_; ++image) {
    if (w.slot_count[image] > UINT32_MAX)
      throw std::invalid_argument(
          "The Gaussians of one image touch more than 2^32 tiles. Render a smaller image or check "
          "the Gaussians' scales.");
    w.slot_start[image + 1] = w.slot_start[image] + w.slot_count[image];
  }
}

// Front to back, then by tile: a counting sort keeps the order within each tile.
void Rendering::sort_image(int image, uint64_t* keys) {
  Workspace& w = *workspace_;
  const float* depth = w.projected[image].depth;
  const Bounds* bounds = w.projected[image].bounds;
  uint32_t* start = w.tile_start.data() + size_t(image) * (tiles_per_image() + 1);
  uint32_t* slot_offset = w.slot_offset.data() + size_t(image) * (count_ + 1);
  std::fill(start, start + tiles_per_image() + 1, 0u);
  size_t visible = 0, slots = 0;
  for (int i = 0; i < count_; ++i) {
    slot_offset[i] = uint32_t(slots);
    if (!bounds[i].visible()) continue;
    uint32_t depth_bits;  // of a positive float: ordered like the float
    std::memcpy(&depth_bits, &depth[i], sizeof depth_bits);
    keys[visible++] = uint64_t(depth_bits) << 32 | uint32_t(i);
    for_tiles(bounds[i], tiles_x_, [&](int tile) { ++start[tile], ++slots; });
  }
  slot_offset[count_] = uint32_t(slots);
  w.slot_count[image] = slots;
  if (slots > UINT32_MAX) return;
  const uint64_t* sorted = radix_sort(keys, keys + count_, visible);
  uint32_t total = 0;
  for (int tile = 0; tile <= tiles_per_image(); ++tile) {
    const uint32_t here = start[tile];
    start[tile] = total;
    total += here;
  }
  Buffer<Entry>& entries = w.entries[image];
  entries.reserve(slots);
  for (size_t i = 0; i < visible; ++i) {
    const uint32_t gaussian = uint32_t(sorted[i]);
    uint32_t slot = slot_offset[gaussian];
    for_tiles(bounds[gaussian], tiles_x_,
              [&](int tile) { entries[start[tile]++] = {gaussian, slot++}; });
  }
  // Each start has moved to the next tile's; move them back.
  for (int tile = tiles_per_image(); tile > 0; --tile) start[tile] = start[tile - 1];
  start[0] = 0;
}

Tile Rendering::tile(int image, int index) const {
  const Workspace& w = *workspace_;
  const uint32_t* start = w.tile_start.data() + size_t(image) * (tiles_per_image() + 1) + index;
  return {w.projected[image].splats,
          w.entries[image].data() + start[0],
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
