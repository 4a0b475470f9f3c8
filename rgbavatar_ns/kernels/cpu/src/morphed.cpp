// The driver for morphed Gaussians.
#include <algorithm>

#include "raster.h"
#include "team.h"

namespace rgbavatar {

namespace {

int blend_chunks_of(int count) { return (count + kBlendChunk - 1) / kBlendChunk; }

constexpr int kFrameChunk = 1024;

}  // namespace

MorphedRendering::MorphedRendering(MorphedScene scene, const Cameras& cameras,
                                   const std::string& instruction_set, int threads)
    : Rendering(scene.batch, scene.count, scene.width, scene.height, cameras, instruction_set) {
  Team team(threads);
  Workspace& w = *workspace_;
  w.frames.reserve(size_t(batch_) * scene.triangles * kFrameFloats);
  scene.frames = w.frames.data();
  lay_out_blending(scene, team);
  const int frame_chunks = (scene.triangles + kFrameChunk - 1) / kFrameChunk;
  team.run(int64_t(batch_) * frame_chunks, [&](int64_t item, int) {
    const int image = int(item / frame_chunks), begin = int(item % frame_chunks) * kFrameChunk;
    kernels_->fill_frames(scene, image, begin, std::min(begin + kFrameChunk, scene.triangles));
  });
  team.run(blend_chunks_of(count_), [&](int64_t chunk, int thread) {
    const int begin = int(chunk) * kBlendChunk;
    kernels_->project_morphed(scene, w.cameras.data(), begin,
                              std::min(begin + kBlendChunk, count_), w.blending[thread],
                              w.projected.data());
  });
  sort(team);
}

void MorphedRendering::lay_out_blending(const MorphedScene& scene, const Team& team) {
  Workspace& w = *workspace_;
  const size_t columns = size_t(batch_) * kBlendChunk;
  const size_t weights = size_t(batch_) * scene.bases * kBlockPixels;
  const size_t floats = columns * (3 + 4 + 3) + weights;
  w.blending.reserve(team.size());
  w.blending_columns.reserve(floats * team.size());
  for (int thread = 0; thread < team.size(); ++thread) {
    float* memory = w.blending_columns.data() + floats * thread;
    w.blending[thread].tangent[0] = memory;
    w.blending[thread].tangent[1] = memory + columns * 3;
    w.blending[thread].tangent[2] = memory + columns * 7;
    w.blending[thread].weight_sums = memory + columns * 10;
  }
}

// Fills the sums of the Gaussians that some tile shows well enough, from all tiles that show them; the
// few that do so faintly are looked at again. Those Gaussians are left in `shown_`.
template <class TargetOf>
void MorphedRendering::add_sightings(const FirstSight& sight, Sightings found,
                                     const TargetOf& target_of, Team& team) {
  Workspace& w = *workspace_;
  w.largest.reserve(count_);
  float* const largest = w.largest.data();
  std::fill(largest, largest + count_, 0.0f);
  Sighting* const end = found.seen + found.count;
  for (Sighting* seen = found.seen; seen < end; ++seen)
    largest[seen->index] = std::max(largest[seen->index], seen->most);
  Sighting* const shown = std::partition(found.seen, end, [&](const Sighting& seen) {
    return largest[seen.index] >= sight.threshold;
  });
  Sighting* const faint =
      std::partition(found.seen, shown, [](const Sighting& seen) { return seen.summed; });
  std::sort(faint, shown, [](const Sighting& a, const Sighting& b) { return a.tile < b.tile; });
  std::vector<Sighting*> starts;  // of the tiles to look at again
  for (Sighting* seen = faint; seen < shown; ++seen)
    if (seen == faint || seen->tile != seen[-1].tile) starts.push_back(seen);
  starts.push_back(shown);
  const int tiles = tiles_per_image();
  if (faint < shown)
    team.run(int64_t(starts.size()) - 1, [&](int64_t item, int thread) {
      Sighting* const first = starts[item];
      kernels_->see_tile(tile(int(first->tile / tiles), int(first->tile % tiles)),
                         target_of(first->tile), w.scratch[thread], first,
                         int(starts[item + 1] - first));
    });
  const auto in_units = [](float sum) { return int64_t(double(sum) * kSightUnit); };
  for (const Sighting* seen = found.seen; seen < shown; ++seen) {
    int64_t* sums = sight.sums + seen->index * size_t(kSightSums);
    for (int k = 0; k + 1 < kSightSums; ++k) sums[k] += in_units(seen->sums[k]);
    float& most = largest[seen->index];
    if (most < 0.0f) continue;  // told before
    sums[kSightSums - 1] = std::max(sums[kSightSums - 1], in_units(most));
    shown_.push_back(seen->index);
    most = -1.0f;
  }
}

double MorphedRendering::forward_loss(const uint8_t* images, const Attribute& background,
                                      const FirstSight* sight, int threads) {
  Team team(threads);
  Workspace& w = *workspace_;
  make_scratch(team.size());
  lay_out_slots(kMoments);
  const int tiles = tiles_per_image();
  const size_t pixels = size_t(width_) * height_;
  const double weight = 1.0 / (3.0 * double(pixels) * batch_);
  w.loss.reserve(size_t(batch_) * tiles);
  if (sight) w.sightings.reserve(w.slot_start[std::min(sight->images, batch_)]);
  Sightings found = {w.sightings.data(), 0};
  const auto target_of = [&](int64_t item) -> TrainingTarget {
    const int b = int(item / tiles);
    return {images + b * pixels * 4, background.of(b), float(weight),
            sight && b < sight->images ? sight : nullptr, &found, item};
  };
  team.run(int64_t(batch_) * tiles, [&](int64_t item, int thread) {
    const int b = int(item / tiles);
    w.loss[item] = kernels_->train_tile(tile(b, int(item % tiles)), target_of(item),
                                        w.scratch[thread],
                                        w.slots.data() + w.slot_start[b] * kMoments);
  });
  shown_.clear();
  if (sight) add_sightings(*sight, found, target_of, team);
  double sum = 0.0;
  for (int64_t item = 0; item < int64_t(batch_) * tiles; ++item) sum += w.loss[item];
  return sum * weight;
}

void MorphedRendering::backward_adam(MorphedScene scene, const MorphedOptimizer* optimizer,
                              float* weight_gradient, float* vertex_gradient, int threads) {
  Team team(threads);
  Workspace& w = *workspace_;
  scene.frames = w.frames.data();
  lay_out_blending(scene, team);
  const int chunks = blend_chunks_of(count_), weights = batch_ * scene.bases;
  w.weight_gradient.reserve(size_t(chunks) * weights);
  float* carried = nullptr;
  if (vertex_gradient) {
    w.carried.reserve(size_t(batch_) * count_ * kCarriedFloats);
    carried = w.carried.data();
  }
  team.run(chunks, [&](int64_t chunk, int thread) {
    const int begin = int(chunk) * kBlendChunk;
    kernels_->update_morphed(scene, w.cameras.data(), begin,
                             std::min(begin + kBlendChunk, count_), w.blending[thread],
                             w.image_slots.data(), optimizer,
                             w.weight_gradient.data() + chunk * weights, carried);
  });
  std::fill(weight_gradient, weight_gradient + weights, 0.0f);
  for (int chunk = 0; chunk < chunks; ++chunk)
    for (int i = 0; i < weights; ++i)
      weight_gradient[i] += w.weight_gradient[size_t(chunk) * weights + i];
  if (!vertex_gradient) return;
  const size_t frame_floats = size_t(scene.triangles) * kFrameFloats;
  w.frame_gradient.reserve(frame_floats * team.size());
  team.run(batch_, [&](int64_t image, int thread) {
    kernels_->mesh_gradient(scene, int(image), carried,
                            w.frame_gradient.data() + frame_floats * thread,
                            vertex_gradient + image * scene.vertices * 3);
  });
}

}  // namespace rgbavatar
