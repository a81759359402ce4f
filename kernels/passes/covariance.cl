// The control variate: the exponential moving covariance of the result's luminance f and the
// lighting's g, as (mean of f, mean of g, covariance, variance of g). [Xie21]

// The coefficient a = Cov(f, g) / Var(g); 1 where both vanish, with or without epsilon.
float find_coefficient(float4 moments, float epsilon)
{
    const float variance = moments.w + epsilon;
    return variance > 0.0f ? (moments.z + epsilon) / variance : 1.0f;
}

// With a frame more. The variance of f is left out: nothing needs it.
float4 update_moments(float4 old, float f, float g, float eta)
{
    const float rest = 1.0f - eta;
    const float df = f - old.x;
    const float dg = g - old.y;
    return (float4)(
        rest * old.x + eta * f, rest * old.y + eta * g, rest * old.z + eta * rest * (df * dg),
        rest * old.w + eta * rest * (dg * dg));
}
