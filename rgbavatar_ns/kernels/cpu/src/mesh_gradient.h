// From the gradients of morphed Gaussians to that of the mesh that carries them.
#pragma once

#include "morphed.h"

namespace rgbavatar::RGBAVATAR_ISA {

// Sums what a triangle's Gaussians pass on to its row of kFrameFloats: matrix, rotation, corner,
// edges and length ratio, in the order of `fill_frames`.
static void sum_frame_gradients(const MorphedScene& scene, const float* carried,
                                float* frame_gradient) {
  const int64_t floats = int64_t(scene.triangles) * kFrameFloats;
  for (int64_t i = 0; i < floats; ++i) frame_gradient[i] = 0.0f;
  for (int i = 0; i < scene.count; ++i) {
    const float* d = carried + int64_t(i) * kCarriedFloats;
    const float *x = d + 8, *along = scene.barycentric + int64_t(i) * 3;
    float* row = frame_gradient + scene.triangle_of[i] * kFrameFloats;
    for (int axis = 0; axis < 3; ++axis) {
      for (int column = 0; column < 3; ++column) row[3 * axis + column] += d[axis] * x[column];
      row[13 + axis] += d[axis];
      row[16 + axis] += d[axis] * along[1];
      row[19 + axis] += d[axis] * along[2];
    }
    for (int k = 0; k < 4; ++k) row[9 + k] += d[3 + k];
    row[22] += d[7];
  }
}

// Corner, first and second edge of a triangle.
struct EdgeGradient {
  Vec3<Wide> corner, first, second;
};

static EdgeGradient edge_gradient(const MorphedScene& scene, const Wide frame[kFrameFloats],
                                  const Wide d[kFrameFloats], const Wide inverse[4]) {
  const auto vec = [](const Wide* c) __attribute__((always_inline)) {
    return Vec3<Wide>{c[0], c[1], c[2]};
  };
  const auto frame_of = [](const Wide* c) __attribute__((always_inline)) {
    return TangentFrame<Wide>{
        {c[0], c[3], c[6]}, {c[1], c[4], c[7]}, {c[2], c[5], c[8]}, {c[9], c[10], c[11], c[12]}};
  };
  const Vec3<Wide> e1 = vec(frame + 16), e2 = vec(frame + 19);
  EdgeGradient out = {vec(d + 13), vec(d + 16), vec(d + 19)};
  tangent_frame_backward(e1, e2, inverse, scene.variant, frame_of(frame), frame_of(d), out.first,
                         out.second);
  if (scene.rest_length) {  // the ratio is the root of |e1 x e2|, over a constant
    const Vec3<Wide> area = cross(e1, e2);
    const Wide square = dot(area, area), zero(0.0f);
    const Wide d_log = select(square > Wide(4e-32f), d[22] * frame[22] * 0.5f, zero);
    const Vec3<Wide> d_area = scaled(area, d_log / max_of(square, Wide(4e-32f)));
    out.first = add_scaled(out.first, cross(e2, d_area), Wide(1.0f));
    out.second = add_scaled(out.second, cross(d_area, e1), Wide(1.0f));
  }
  return out;
}

static void mesh_gradient(const MorphedScene& scene, int image, const float* carried,
                          float* frame_gradient, float* vertex_gradient) {
  const float* frames = scene.frames + int64_t(image) * scene.triangles * kFrameFloats;
  sum_frame_gradients(scene, carried + int64_t(image) * scene.count * kCarriedFloats,
                      frame_gradient);
  for (int i = 0; i < scene.vertices * 3; ++i) vertex_gradient[i] = 0.0f;
  for (int first = 0; first < scene.triangles; first += kLanes) {
    const int lanes = scene.triangles - first < kLanes ? scene.triangles - first : kLanes;
    const Rows<kFrameFloats> frame_rows(frames, first, lanes);
    const Rows<kFrameFloats> gradient_rows(frame_gradient, first, lanes);
    Wide frame[kFrameFloats], d[kFrameFloats], inverse[4];
    for (int k = 0; k < kFrameFloats; k += 4) {
      load_columns([&](int i) { return frame_rows.data + i * kFrameFloats + k; }, frame + k);
      load_columns([&](int i) { return gradient_rows.data + i * kFrameFloats + k; }, d + k);
    }
    load_quats(scene.edges_to_frame, first, lanes, inverse);
    const EdgeGradient edges = edge_gradient(scene, frame, d, inverse);
    float corner[kLanes * 3], e1[kLanes * 3], e2[kLanes * 3];
    store_vec3(edges.corner, corner, 0, kLanes);
    store_vec3(edges.first, e1, 0, kLanes);
    store_vec3(edges.second, e2, 0, kLanes);
    for (int lane = 0; lane < lanes; ++lane) {
      const int64_t* vertices = scene.triangle_vertices + int64_t(first + lane) * 3;
      for (int axis = 0; axis < 3; ++axis) {
        const int at = lane * 3 + axis;
        vertex_gradient[vertices[0] * 3 + axis] += corner[at] - e1[at] - e2[at];
        vertex_gradient[vertices[1] * 3 + axis] += e1[at];
        vertex_gradient[vertices[2] * 3 + axis] += e2[at];
      }
    }
  }
}

}  // namespace rgbavatar::RGBAVATAR_ISA
