/* What every program reads of a candidate: PARAMETERS scalars, each for all lanes. */

INLINED Params broadcast_parameters(global const scalar *parameters) {
    Params p;
    real *value = (real *)&p;
    UNROLLED
    for (int i = 0; i < PARAMETERS; ++i) value[i] = (real)(parameters[i]);
    return p;
}
