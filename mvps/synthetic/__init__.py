"""Scenes whose answer is known: an object made by formula, photographed by the program's own image model.

Shape     the zero set of a function f(x), negative inside: ellipsoids d_k joined by the smooth minimum
          -blend log sum_k exp(-d_k / blend), with folds, bent waves added to f from the waist downwards, and a bowl, a ball
          taken away by the smooth maximum. Meshed by marching cubes, vertices moved onto f = 0 by Newton steps
          along grad f, normals grad f / |grad f|.
Material  albedo: patches, nearest of random sites in space, times a slow variation; two specular lobes, strong on one side
          of the object (glossy) and weak on the other.
Light     directional, spread over the cap of directions within `spread` of the optical axis, a lattice of equal areas.
Image     2 x 2 rays a pixel, attached and cast shadows, no inter-reflection, Gaussian sensor noise, 16-bit rounding, clipping.

Everything is drawn from the seed: the same settings give the same bytes.

    from mvps.synthetic.settings import SceneSettings
    from mvps.synthetic.scene import make_scene, render_capture
    from mvps.synthetic.files import write_capture

    capture, truth = render_capture(SceneSettings(views=6, seed=3))
    write_capture(capture, truth, Path("made"))
"""
