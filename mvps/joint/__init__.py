"""Stage II: lights, normals, reflectance and vertices of an explicit mesh, solved together.

The rounds
    refine.py            the rounds, and what they come to
    photometry.py        the photometric part of a round
    state.py             what rounds hand to each other
    one_view.py          rounds of a single view (bas_relief.py: its bas-relief)
    lambertian.py        Lambert's law alone, on a surface that stays

Samples
    observe.py           what the photographs say about the vertices
    reflectance.py       the same in colour, with all that predicts them but colour
    thinned.py           fewer lights of every view
    pixels.py            normals of single views at their pixels

Vertices and lights
    blocks.py            the image model's derivatives and normal equations
    steps.py             steps of the vertices, ties, confidence
    lights.py            lights with the vertices eliminated
    patches.py           patches of the mesh whose mean slope is known
    lighting.py          a round's lights and law
    shadowed.py          light between surfaces, told deep in shadow
    grey.py              lights without their colours, and with them
    colours.py           colours of body, lobes and lights

The model
    choosing.py          its components on trial
    trial.py             their errors on held-out samples
    neural.py            the neural residual

Positions
    agreement.py         where views agree that the surface is
    photoconsistency.py  where single photographs agree
    borders.py           where borders of cast shadows say that it is deeper
    fused.py             the views' normals together, on vertices and faces
    sharpened.py         what pixels blurred of them
    vertices.py          positions from normals, agreement and masks
    unseen.py            what no view sees
    detail.py            a finer mesh than the one that was solved on
    bundle.py            the cameras' poses from photographs

Results
    shown.py             the normals that a result is shaded with
    stated.py            the error that is stated with them
    held_out.py          lights of photographs that were kept back
"""
