// The loops over Gaussians and pixels. Compiled once per instruction set with RGBAVATAR_ISA naming
// it; uses no inline function or template of the standard library, because the linker would merge
// those of different instruction sets.
#include "harmonics.h"
#include "morphed.h"
#include "mesh_gradient.h"
#include "packed.h"
#include "pose.h"
#include "similarity_rows.h"
#include "train_tile.h"

namespace rgbavatar::RGBAVATAR_ISA {

extern const Kernels kernels;
const Kernels kernels = {project_image, forward_tile, backward_tile, average_tile,
                         project_image_backward, fill_frames, project_morphed, train_tile,
                         see_tile, update_morphed, mesh_gradient, project_packed, pose_vertices,
                         similarity_rows, similarity_gradient_rows, harmonic_colors,
                         harmonic_gradient};

}  // namespace rgbavatar::RGBAVATAR_ISA
