// Which copy of the loops runs.
#include <stdexcept>

#include "raster.h"

namespace rgbavatar {

namespace generic {
extern const Kernels kernels;
}
#if defined(RGBAVATAR_X86)
namespace avx2 {
extern const Kernels kernels;
}
namespace avx512 {
extern const Kernels kernels;
}
#endif

namespace {

struct InstructionSet {
  const char* name;
  const Kernels* kernels;
};

// The sets this processor runs, the fastest first.
std::vector<InstructionSet> supported() {
  std::vector<InstructionSet> sets;
#if defined(RGBAVATAR_X86)
  __builtin_cpu_init();
  const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  if (avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512bw"))
    sets.push_back({"avx512", &avx512::kernels});
  if (avx2) sets.push_back({"avx2", &avx2::kernels});
#endif
  sets.push_back({"generic", &generic::kernels});
  return sets;
}

}  // namespace

const Kernels* kernels_for(const std::string& name) {
  std::string known;
  for (const InstructionSet& set : supported()) {
    if (name.empty() || name == set.name) return set.kernels;
    known += known.empty() ? set.name : std::string(", ") + set.name;
  }
  throw std::invalid_argument("This processor does not run the instruction set '" + name +
                              "'. Choose one of: " + known + ".");
}

std::vector<std::string> instruction_sets() {
  std::vector<std::string> names;
  for (const InstructionSet& set : supported()) names.push_back(set.name);
  return names;
}

}  // namespace rgbavatar
