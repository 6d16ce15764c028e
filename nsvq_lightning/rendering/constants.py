"""Constants of 3D Gaussian Splatting's rasterizer (Kerbl et al. 2023); every back-end shares them."""

# Splats whose centre is nearer than this along the viewing axis are culled, in units of a scene whose cameras have an
# extent of 5 (:mod:`nsvq_lightning.rendering.frame`); of a camera that says nothing else.
NEAR = 0.2

# Added to both variances of the projected Gaussian, square pixels.
BLUR = 0.3

# Contributions below one 8-bit step are skipped.
ALPHA_MIN = 1.0 / 255.0

# Smallest factor of an opacity by sampling: far below what any pixel shows, and its logarithm is finite.
FAINTEST = 1e-6

# A splat counts as at most so many times as near as in training, squared: its blur covers any picture.
MAX_RATIO = 1e9

# Opacity of one splat at one pixel is capped here; the cap has no gradient.
ALPHA_MAX = 0.99

# A pixel is finished before the splat that would bring its transmittance below this.
TRANSMITTANCE_MIN = 1e-4

# The projection's Jacobian is evaluated at most this fraction of half the image size outside the image.
FRUSTUM_MARGIN = 0.3

# Quaternions with a larger component are first scaled by ``SHRINK``: their squares would overflow in float32.
HUGE_QUATERNION, SHRINK = 1e18, 2.0**-66

# Float32 back-ends cull splats whose sum of both variances is larger, square pixels: even the sum is unsafe there.
LARGEST_FOOTPRINT = 1e36

# Float32 back-ends cull splats with any larger value on the image plane: it comes from broken attributes.
FINITE = 1e30

# Where the sum of both variances is larger, square pixels, the determinant is computed in units of that sum: its
# terms would overflow in float32.
HUGE_FOOTPRINT = 1e10
