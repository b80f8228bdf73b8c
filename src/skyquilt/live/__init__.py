"""The live story: a map that grows photo by photo (part D of the methods).

    accept (durable) -> place (metadata) -> draw -> link -> settle -> draw -> close loops in the
    background

`story.LiveMap` is the file to read first. `intake` and `watch` bring photos in; `arriving` and
`metadata` place them, `refining`, `neighbours`, `linking` and `placing` settle them; `showing` and
`drawing` keep the tiles; `schedule`, `closing` and `adopting` bundle whole blocks behind the
scenes; `finish` runs the batch story at the end.
"""
