// The engine in one precision and dimension: CORTADO_REAL is the type of its numbers, CORTADO_DIMENSION 2 or 3.
#include "cortado/rollout.hpp"

template std::unique_ptr<cortado::Engine> cortado::engine_of<CORTADO_REAL, CORTADO_DIMENSION>(const Scene&, int);
