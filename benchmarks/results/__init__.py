"""Whether the results of two versions of this code are bit-identical.

    python -m benchmarks.results save OLD                        # at the old version
    python -m benchmarks.results save NEW --inputs OLD/inputs    # at the new one
    python -m benchmarks.results compare OLD NEW --renames renames.toml

`save` runs the commands on recordings that it simulates, and on the real ones of WEPOSE_DATA, and stores every number
that they write as an array under a key such as ``track/mild/amekf/causal/left_forearm_qx``. Texts are not stored.
`compare` holds two such folders against each other.

`adapter` is the one file that knows the names of the project; `inputs` makes the recordings; `tasks` lists what is run;
`arrays` makes arrays of files and values; `comparison` compares two folders.
"""
