#include "raster.h"

#include <algorithm>
#include <cstring>
#include <mutex>

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
  w.tiles.reserve(size_t(batch_) * count_);
  w.projected.reserve(batch_);
  for (int image = 0; image < batch_; ++image) {
    const int from = cameras.count == 1 ? 0 : image;
    float* to = &w.cameras[size_t(image) * kCameraFloats];
    std::memcpy(to, cameras.world_to_camera + from * 16, 16 * sizeof(float));
    std::memcpy(to + 16, cameras.focal_px + from * 2, 2 * sizeof(float));
    std::memcpy(to + 18, cameras.principal_point_px + from * 2, 2 * sizeof(float));
    const size_t first = size_t(image) * count_;
    w.projected[image] = {w.splats.data() + first, w.depth.data() + first,
                          w.tiles.data() + first, tiles_x_, tiles_per_image()};
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

void Rendering::make_scratch(int threads) {
  Workspace& w = *workspace_;
  const size_t checkpoints = w.most_entries / kGroupSplats + 1;
  w.scratch.reserve(threads);
  w.checkpoints.reserve(threads * checkpoints);
  for (int i = 0; i < threads; ++i)
    w.scratch[i].checkpoints = w.checkpoints.data() + i * checkpoints;
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

void Rendering::draw(const Attribute& background, int first, int sets, float* image, float* alpha,
                     float* depth, int threads) {
  Team team(threads);
  make_scratch(team.size());
  const size_t pixels = size_t(width_) * height_;
  team.run(int64_t(sets) * tiles_per_image(), [&](int64_t item, int thread) {
    const int place = int(item / tiles_per_image()), b = first + place;
    const ForwardOutput out = {background.of(b), image + place * pixels * 3,
                               alpha + place * pixels, depth ? depth + place * pixels : nullptr};
    kernels_->forward_tile(tile(b, int(item % tiles_per_image())), out,
                           workspace_->scratch[thread]);
  });
}

void Rendering::average(const Attribute& images, int channels, float* weighted_sum,
                        float* weight_sum, float* max_weight, int threads) {
  Team team(threads);
  Workspace& w = *workspace_;
  const int width = channels + 2;
  make_scratch(team.size());
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

void Rendering::backward(const Scene& scene, const Attribute& background, const float* image_grad,
                         const float* alpha_grad, const SceneGradient& gradient, int threads) {
  Team team(threads);
  Workspace& w = *workspace_;
  make_scratch(team.size());
  lay_out_slots(kMoments);
  const size_t pixels = size_t(width_) * height_;
  team.run(int64_t(batch_) * tiles_per_image(), [&](int64_t item, int thread) {
    const int b = int(item / tiles_per_image());
    const auto of_image = [&](const float* data, int width) {
      return data ? data + b * pixels * width : nullptr;
    };
    const BackwardInput in = {background.of(b), of_image(image_grad, 3), of_image(alpha_grad, 1)};
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
