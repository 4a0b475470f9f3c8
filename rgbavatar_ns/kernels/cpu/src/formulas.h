// The shared formulas for this instruction set.
#pragma once

#include "layout.h"
#include "quads.h"

namespace rgbavatar::RGBAVATAR_ISA {

#include "../../shared/gaussian_math.h"
#include "../../shared/tangent_math.h"

using C = BlendingConstants;

}  // namespace rgbavatar::RGBAVATAR_ISA
