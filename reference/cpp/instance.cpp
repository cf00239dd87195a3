// The engine in one precision: CORTADO_REAL is its type, CORTADO_NAME what makes it.
#include "cortado/rollout.hpp"

namespace cortado {

std::unique_ptr<Engine> CORTADO_NAME(const Scene& scene, int threads) {
    if (scene.dimension == 2) return std::make_unique<Rollout<CORTADO_REAL, 2>>(scene, threads);
    return std::make_unique<Rollout<CORTADO_REAL, 3>>(scene, threads);
}

}  // namespace cortado
