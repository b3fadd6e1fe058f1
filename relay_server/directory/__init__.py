"""The directory: which services and applications there are, and where; what robots have is in it by itself (SPEC 1.15).

``entries`` is what is told and asked, ``addresses`` what an address may be, ``own`` what robots have, ``leases`` lets
go what nobody renews, ``changes`` is for those who follow, ``desk`` is whom people ask, ``house`` puts all together.
"""
