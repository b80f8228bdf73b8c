"""The live story: a map that grows photo by photo (part D of the methods).

    accept (durable) -> place (metadata) -> draw -> link -> settle -> draw -> close loops in the background

`story.LiveMap` is the file to read first; `intake` and `watch` bring photos in, `placing` says where they are,
`drawing` shows them, `closing` bundles whole blocks behind the scenes, `finish` runs the batch story at the end.
"""
