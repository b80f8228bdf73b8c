"""Stage: clips -> looks -> chosen frames, each of which is a Photo like any other.

`read.read_clip` reads a clip's header and the positions beside it, `looks` looks through it,
`choice.choose` picks frames, `clock.find_offset` finds how the clocks of clip and positions differ,
`decoder.frame_of` decodes one frame on demand.
"""
