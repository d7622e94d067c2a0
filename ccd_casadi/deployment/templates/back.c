/* Back-calculation: states x forces. */
static const double L[] = $L;
